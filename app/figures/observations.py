"""Curves of observations, for tasks without a robot to draw."""

from collections.abc import Sequence

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray
from plotly.subplots import make_subplots

from app import text
from app.data.buffer import WINDOW
from app.data.replays import Replay
from app.figures.base import LAYOUT, X_AXIS, Y_AXIS
from app.theme import NEUTRAL, learner_colour

MOST = 12
"""maximum number of drawn dimensions; the figure says if some were left out"""
HEAVY, LIGHT = "#c2571f", "#4f7fc9"


def observed_curves(replay: Replay, frame: int, height: int) -> go.Figure:
    """Each dimension of an episode against seconds, `height` pixels each, with the model's."""
    obs = np.asarray(replay.episode.obs)
    seconds = replay.dt * np.arange(len(obs))
    figure = _rows(replay.names, obs.shape[1], height)
    for i in range(min(obs.shape[1], MOST)):
        figure.add_trace(_line(seconds, obs[:, i], NEUTRAL, "real"), i + 1, 1)
        if replay.imagined is not None:
            colour = learner_colour(replay.learner)
            line = _line(seconds, replay.imagined.obs[:, i], colour, "imagined")
            figure.add_trace(line, i + 1, 1)
    figure.add_vline(x=frame * replay.dt, line={"color": NEUTRAL, "width": 1.5, "dash": "dot"})
    return _finished(figure, "seconds", obs.shape[1], f"observations {replay.name}")


def moments_figure(
    heavy: NDArray, light: NDArray, names: Sequence[str], height: int, keep: str
) -> go.Figure:
    """Observations around heavy and light transitions, (R, 2 WINDOW + 1, O) each.

    A zoom lasts while `keep`, the run's id, is the same.
    """
    dims = (heavy if len(heavy) else light).shape[-1]
    figure = _rows(names, dims, height)
    steps = np.arange(-WINDOW, WINDOW + 1)
    for i in range(min(dims, MOST)):
        for group, colour, name in ((light, LIGHT, "light"), (heavy, HEAVY, "heavy")):
            for moment in group:
                figure.add_trace(_line(steps, moment[:, i], colour, name), i + 1, 1)
    return _finished(figure, "steps around", dims, f"moments {keep}")


def _rows(names: Sequence[str], dims: int, height: int) -> go.Figure:
    shown = min(dims, MOST)
    titles = [names[i] if i < len(names) else f"observation {i + 1}" for i in range(shown)]
    spacing = min(0.05, 0.5 / max(shown - 1, 1))
    figure = make_subplots(shown, 1, shared_xaxes=True, vertical_spacing=spacing)
    for i, title in enumerate(titles):
        figure.update_yaxes(title_text=text.plotly(title[:24]), row=i + 1, col=1)
    figure.update_layout(height=height * shown)
    return figure


def _line(x: NDArray, y: NDArray, colour: str, name: str) -> go.Scatter:
    return go.Scatter(
        x=x,
        y=y,
        name=name,
        mode="lines",
        showlegend=False,
        line={"color": colour, "width": 1.4},
        hovertemplate=f"{name}<br>%{{y:.3g}}<extra></extra>",
    )


def _finished(figure: go.Figure, x: str, dims: int, keep: str) -> go.Figure:
    figure.update_layout(**LAYOUT, uirevision=keep)
    figure.update_xaxes(**X_AXIS)
    figure.update_yaxes(**Y_AXIS)
    words = x if dims <= MOST else f"{x}; the first {MOST} of {dims} dimensions"
    figure.update_xaxes(title_text=words, row=min(dims, MOST), col=1)
    return figure
