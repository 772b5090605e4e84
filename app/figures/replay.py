"""The return curve to choose an episode from, and the episode step by step."""

from collections.abc import Sequence

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray
from plotly.subplots import make_subplots

from app import text
from app.data.buffer import WINDOW
from app.data.replays import Replay
from app.figures.base import LAYOUT, X_AXIS, Y_AXIS, decimate, note, steps_in_words, styled, upright
from app.theme import NEUTRAL, learner_colour, learner_label, learner_symbol
from tom.analysis.curves import Curve

POINTS = 2000
MOST = 12
"""maximum number of drawn dimensions; the figure says if some were left out"""
HEAVY, LIGHT = "#c2571f", "#4f7fc9"


def return_curve(
    curve: Curve, step: int, returns: NDArray[np.float64], chosen: int, height: int
) -> go.Figure:
    """The mean return at every evaluation; at `step` also each episode (E,), one marked."""
    colour = learner_colour(curve.learner)
    steps, values, thinned = decimate(curve.step, curve.value, POINTS)
    figure = go.Figure(
        go.Scatter(
            x=steps,
            y=values,
            name="mean of the evaluation",
            mode="lines+markers" if len(steps) < 60 else "lines",
            line={"color": colour, "width": 2},
            marker={"size": 7, "symbol": learner_symbol(curve.learner)},
            hovertemplate="step %{x:,}<br>mean return %{y:,.5~g}<extra></extra>",
        )
    )
    at_rest = {"size": 9, "symbol": "line-ew", "line": {"width": 2, "color": NEUTRAL}}
    others = np.arange(len(returns)) != chosen
    for name, which, marker in (
        ("its episodes", others, at_rest),
        ("the one shown", ~others, {"color": colour, "size": 11, "symbol": "circle"}),
    ):
        index = np.flatnonzero(which)
        figure.add_trace(
            go.Scatter(
                x=np.full(len(index), step),
                y=returns[index],
                customdata=index + 1,
                meta=(index + 1).tolist(),  # returned by a click
                name=name,
                mode="markers",
                marker=marker,
                hovertemplate="episode %{customdata}<br>return %{y:,.5~g}<extra></extra>",
            )
        )
    styled(figure, steps_in_words([curve.env]), height, keep=f"returns {curve.run_id}")
    figure.update_yaxes(title_text="return")
    if len(steps) < 2:
        figure.update_xaxes(range=[0, 2 * step], tickvals=[step])
    return note(figure, f"thinned to {POINTS} points") if thinned else figure


def reward_curve(replay: Replay, frame: int, height: int) -> go.Figure:
    """The real and the predicted reward of each step, with the frame marked."""
    figure = go.Figure()
    seconds = replay.dt * np.arange(replay.episode.length)
    lines = [("real", replay.episode.reward, NEUTRAL, 2.0)]
    if replay.imagined is not None:
        name = f"imagined by {text.plotly(learner_label(replay.learner))}'s model"
        lines.append((name, replay.imagined.reward, learner_colour(replay.learner), 1.5))
    for name, values, colour, width in lines:
        figure.add_trace(_line(seconds, values, name, colour, width, "reward"))
    return _timeline(figure, replay, frame, "reward a step", height, "replay-reward")


def error_curve(replay: Replay, frame: int, height: int) -> go.Figure:
    """The distance of the predicted state from the real one at each step; needs a ghost."""
    seconds = replay.dt * np.arange(1, replay.episode.length + 1)
    colour = learner_colour(replay.learner)
    figure = go.Figure(_line(seconds, replay.error, "distance", colour, 1.5, "distance"))
    figure.update_traces(showlegend=False)
    _timeline(figure, replay, frame, "distance (std)", height, "replay-error")
    if np.isfinite(replay.error).any():
        return figure
    return note(figure, "no distance: one step, or states that change alike, have no scale")


def _line(
    x: NDArray, y: NDArray, name: str, colour: str, width: float, quantity: str
) -> go.Scatter:
    return go.Scatter(
        x=x,
        y=y,
        name=name,
        mode="lines",
        line={"color": colour, "width": width},
        hovertemplate=f"{name}<br>%{{x:.2f}} s<br>{quantity} %{{y:.3g}}<extra></extra>",
    )


def _timeline(
    figure: go.Figure, replay: Replay, frame: int, title: str, height: int, keep: str
) -> go.Figure:
    marks = [upright(frame * replay.dt, 1.5, "dot")]
    styled(figure, "seconds", height, keep=f"{keep} {replay.name}", marks=marks)
    figure.update_yaxes(title_text=title)
    return figure


def observed_curves(replay: Replay, frame: int, height: int) -> go.Figure:
    """Each dimension of an episode against seconds, `height` pixels each, with the model's."""
    obs = np.asarray(replay.episode.obs)
    seconds = replay.dt * np.arange(len(obs))
    figure = _rows(replay.names, obs.shape[1], height)
    for i in range(min(obs.shape[1], MOST)):
        figure.add_trace(_observed_line(seconds, obs[:, i], NEUTRAL, "real"), i + 1, 1)
        if replay.imagined is not None:
            colour = learner_colour(replay.learner)
            line = _observed_line(seconds, replay.imagined.obs[:, i], colour, "imagined")
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
                figure.add_trace(_observed_line(steps, moment[:, i], colour, name), i + 1, 1)
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


def _observed_line(x: NDArray, y: NDArray, colour: str, name: str) -> go.Scatter:
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
