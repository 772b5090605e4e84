"""The return curve to choose an episode from, and the episode step by step."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray

from app import text
from app.data.buffer import WINDOW
from app.data.replays import Replay
from app.figures.base import line, note, panels, step_axis_title, styled
from app.figures.curves import return_line
from app.theme import NEUTRAL, learner_colour
from tom.analysis.curves import Curve
from tom.learners import learner_label

MAX_DIMENSIONS = 12
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
    x, kept = step_axis_title([curve.env]), f"returns {curve.run_id}"
    styled(figure, x, height, keep=kept, y="return", x_axis=lone)
    return note(figure, thinned)


def episode_curves(replay: Replay, frame: int, height: int) -> go.Figure:
    """The reward of each step, real and predicted, and the distance of the prediction, if any."""
    blank, words = [np.nan], ["reward a step"]
    lines = [("real", NEUTRAL, np.append(replay.episode.reward, blank)[:, None])]
    if replay.imagined is not None:
        name = f"imagined by {text.plotly(learner_label(replay.learner))}'s model"
        two = np.append(replay.imagined.reward, blank), np.append(blank, replay.error)
        lines.append((name, learner_colour(replay.learner), np.stack(two, 1)))
        words.append("distance (std)")
    figure = _episode_figure(replay, lines, words, frame, height, "rewards")
    nothing = replay.imagined is not None and not np.isfinite(replay.error).any()
    return note(
        figure, ["no distance: a single step, or steps that are all alike, give no scale"] * nothing
    )


def observed_curves(replay: Replay, frame: int, height: int) -> go.Figure:
    """Each dimension of an episode against seconds, `height` pixels each, with the model's."""
    lines = [("real", NEUTRAL, np.asarray(replay.episode.obs))]
    if replay.imagined is not None:
        lines.append(("imagined", learner_colour(replay.learner), replay.imagined.obs))
    return _episode_figure(replay, lines, replay.names, frame, height, "observations")


def _episode_figure(
    replay: Replay,
    lines: Sequence[tuple[str, str, NDArray]],
    names: Sequence[str],
    frame: int,
    height: int,
    what: str,
) -> go.Figure:
    """Lines (name, colour, (H + 1, D)) against seconds, with the frame marked."""
    seconds = replay.dt * np.arange(len(replay.episode.obs))
    figure = _dimension_panels(seconds, "seconds", lines, names, height, f"{what} {replay.name}")
    mark = {"color": NEUTRAL, "width": 1.5, "dash": "dot"}
    return figure.add_vline(x=frame * replay.dt, line=mark)


def observation_windows(
    heavy: NDArray, light: NDArray, names: Sequence[str], height: int, keep: str
) -> go.Figure:
    """Observations around heavy and light transitions, (R, 2 WINDOW + 1, O) each.

    A zoom lasts while `keep`, the run's id, is the same.
    """
    lines = [("light", LIGHT, moment) for moment in light]
    lines += [("heavy", HEAVY, moment) for moment in heavy]
    steps = np.arange(-WINDOW, WINDOW + 1)
    return _dimension_panels(steps, "steps around", lines, names, height, f"moments {keep}")


def _dimension_panels(
    x: NDArray,
    title: str,
    lines: Sequence[tuple[str, str, NDArray]],
    names: Sequence[str],
    height: int,
    keep: str,
) -> go.Figure:
    """A row of `height` pixels for each dimension of the lines: (name, colour, (T, O))."""
    dims = lines[-1][2].shape[-1]
    shown = min(dims, MAX_DIMENSIONS)
    spacing = min(0.05, 0.5 / max(shown - 1, 1))
    apart = {"shared_xaxes": True, "vertical_spacing": spacing}
    figure = panels(shown, 1, height * shown, keep, **apart)
    for i in range(shown):
        named: set[str] = set()
        for name, colour, values in lines:
            hover = f"{name}<br>%{{y:.3g}}<extra></extra>"
            more = {"name": name, "legendgroup": name, "showlegend": not i and name not in named}
            if i < values.shape[1]:
                figure.add_trace(line(x, values[:, i], colour, 1.4, hover, **more), i + 1, 1)
            named.add(name)
        words = names[i] if i < len(names) else f"observation {i + 1}"
        figure.update_yaxes(title_text=text.plotly(words[:24]), row=i + 1, col=1)
    words = (
        title
        if dims <= MAX_DIMENSIONS
        else f"{title}; the first {MAX_DIMENSIONS} of {dims} dimensions"
    )
    return figure.update_xaxes(title_text=words, row=shown, col=1)
