"""The return curve to choose an episode from, and the episode step by step."""

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray

from app import text
from app.data.replays import Replay
from app.figures.base import note, steps_in_words, styled, upright
from app.figures.lines import decimate
from app.theme import NEUTRAL, learner_colour, learner_label, learner_symbol
from tom.analysis.curves import Curve

POINTS = 2000


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
