"""The return curve to choose an episode from, and the episode step by step."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray

from app import text
from app.data.buffer import WINDOW
from app.data.replays import Replay
from app.figures.base import line, note, panels, steps_in_words, styled, upright
from app.figures.curves import return_line
from app.theme import NEUTRAL, learner_colour, learner_label
from tom.analysis.curves import Curve

MOST = 12
"""maximum number of drawn dimensions; the figure says if some were left out"""
HEAVY, LIGHT = "#c2571f", "#4f7fc9"


def return_curve(
    curve: Curve, step: int, returns: NDArray[np.float64], chosen: int, height: int
) -> go.Figure:
    """The mean return at every evaluation; at `step` also each episode (E,), one marked."""
    # A click on it means the evaluation, one on a mark the episode that its `meta` has.
    more: dict[str, Any] = {"name": "mean of the evaluation", "meta": None, "showlegend": True}
    means, thinned = return_line(curve, **more)
    figure, colour = go.Figure(means), learner_colour(curve.learner)
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
    lone = {"range": [0, 2 * step], "tickvals": [step]} if len(curve.step) < 2 else {}
    x, kept = steps_in_words([curve.env]), f"returns {curve.run_id}"
    styled(figure, x, height, keep=kept, y="return", x_axis=lone)
    return note(figure, thinned)


def reward_curve(replay: Replay, frame: int, height: int) -> go.Figure:
    """The real and the predicted reward of each step, with the frame marked."""
    lines = [("real", replay.episode.reward, NEUTRAL, 2.0)]
    if replay.imagined is not None:
        name = f"imagined by {text.plotly(learner_label(replay.learner))}'s model"
        lines.append((name, replay.imagined.reward, learner_colour(replay.learner), 1.5))
    return _steps(replay, "reward", lines, 0, frame, height, y="reward a step")


def error_curve(replay: Replay, frame: int, height: int) -> go.Figure:
    """The distance of the predicted state from the real one at each step; needs a ghost."""
    lines = [("distance", replay.error, learner_colour(replay.learner), 1.5)]
    more = {"y": "distance (std)", "showlegend": False}
    figure = _steps(replay, "distance", lines, 1, frame, height, **more)
    nothing = not np.isfinite(replay.error).any()
    return note(
        figure, ["no distance: one step, or states that change alike, have no scale"] * nothing
    )


def _steps(
    replay: Replay,
    of: str,
    lines: Sequence[tuple[str, NDArray, str, float]],
    first: int,
    frame: int,
    height: int,
    **more: Any,
) -> go.Figure:
    """Lines (name, values (H,), colour, width) against seconds, from step `first` on."""
    figure = go.Figure()
    for name, values, colour, width in lines:
        seconds = replay.dt * np.arange(first, first + len(values))
        hover = f"{name}<br>%{{x:.2f}} s<br>{of} %{{y:.3g}}<extra></extra>"
        figure.add_trace(line(seconds, values, colour, width, hover, name=name))
    marks, kept = [upright(frame * replay.dt, 1.5, "dot")], f"replay-{of} {replay.name}"
    return styled(figure, "seconds", height, keep=kept, marks=marks, **more)


def observed_curves(replay: Replay, frame: int, height: int) -> go.Figure:
    """Each dimension of an episode against seconds, `height` pixels each, with the model's."""
    obs = np.asarray(replay.episode.obs)
    lines = [("real", NEUTRAL, obs)]
    if replay.imagined is not None:
        lines.append(("imagined", learner_colour(replay.learner), replay.imagined.obs))
    seconds, kept = replay.dt * np.arange(len(obs)), f"observations {replay.name}"
    figure = _dimensions(seconds, "seconds", lines, replay.names, height, kept)
    mark = {"color": NEUTRAL, "width": 1.5, "dash": "dot"}
    return figure.add_vline(x=frame * replay.dt, line=mark)


def moments_figure(
    heavy: NDArray, light: NDArray, names: Sequence[str], height: int, keep: str
) -> go.Figure:
    """Observations around heavy and light transitions, (R, 2 WINDOW + 1, O) each.

    A zoom lasts while `keep`, the run's id, is the same.
    """
    lines = [("light", LIGHT, moment) for moment in light]
    lines += [("heavy", HEAVY, moment) for moment in heavy]
    steps = np.arange(-WINDOW, WINDOW + 1)
    return _dimensions(steps, "steps around", lines, names, height, f"moments {keep}")


def _dimensions(
    x: NDArray,
    title: str,
    lines: Sequence[tuple[str, str, NDArray]],
    names: Sequence[str],
    height: int,
    keep: str,
) -> go.Figure:
    """A row of `height` pixels for each dimension of the lines: (name, colour, (T, O))."""
    dims = lines[0][2].shape[-1]
    shown = min(dims, MOST)
    spacing = min(0.05, 0.5 / max(shown - 1, 1))
    apart = {"shared_xaxes": True, "vertical_spacing": spacing}
    figure = panels(shown, 1, height * shown, keep, **apart)
    for i in range(shown):
        for name, colour, values in lines:
            hover = f"{name}<br>%{{y:.3g}}<extra></extra>"
            trace = line(x, values[:, i], colour, 1.4, hover, name=name, showlegend=False)
            figure.add_trace(trace, i + 1, 1)
        words = names[i] if i < len(names) else f"observation {i + 1}"
        figure.update_yaxes(title_text=text.plotly(words[:24]), row=i + 1, col=1)
    words = title if dims <= MOST else f"{title}; the first {MOST} of {dims} dimensions"
    return figure.update_xaxes(title_text=words, row=shown, col=1)
