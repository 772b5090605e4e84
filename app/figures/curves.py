"""Metrics against env steps or another axis: single runs, and groups with their band."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray

from app import text
from app.data.aggregate import GRID, Curve, Group, decimate, smoothed
from app.figures.base import DASHES, ENV_STEPS, note, steps_in_words, styled
from app.figures.logs import cut_bands, left_out
from app.theme import faded, learner_colour, learner_label, learner_symbol
from tom.metrics import describe

POINTS = 1500
"""points of a line at most; what is left out is said on the figure"""


@dataclass(frozen=True)
class Axes:
    """How the figure's axes are drawn."""

    x: str = ENV_STEPS
    log_x: bool = False
    log_y: bool = False


PLAIN = Axes()


def metric_title(metric: str) -> str:
    """A metric's path, its words in brackets where the table has some."""
    words = describe(metric)
    return metric if words == metric else f"{metric}: {words}"


def run_curves(
    curves: Sequence[Curve], metric: str, height: int, *, legend: bool, axes: Axes = PLAIN
) -> go.Figure:
    """One line a run, coloured by learner; the runs of one learner differ in their dashes."""
    figure = go.Figure()
    words = []
    learners = [curve.learner for curve in curves]
    for i, curve in enumerate(curves):
        step, value, cut = decimate(curve.step, curve.value, POINTS)
        if cut:
            words = [f"thinned to {POINTS} points a line"]
        figure.add_trace(
            go.Scatter(
                x=step,
                y=value,
                uid=curve.run_id,
                name=text.plotly(f"{learner_label(curve.learner)} s{curve.seed}"),
                meta=curve.run_id,
                mode="lines+markers" if len(step) < 40 else "lines",
                line={
                    "color": learner_colour(curve.learner),
                    "width": 2,
                    "dash": DASHES[learners[:i].count(curve.learner) % len(DASHES)],
                },
                marker={"size": 5, "symbol": learner_symbol(curve.learner)},
                hovertemplate=_hover(curve, axes.x),
                showlegend=legend,
            )
        )
    _draw_axes(figure, metric, height, axes, [curve.env for curve in curves])
    words += left_out([(c.step, c.value) for c in curves], log_x=axes.log_x, log_y=axes.log_y)
    return note(figure, "<br>".join(words)) if words else figure


def group_curves(
    groups: Sequence[Group],
    metric: str,
    height: int,
    *,
    singles: bool,
    axes: Axes = PLAIN,
    window: int = 1,
) -> go.Figure:
    """A line a group with its band; thin lines for single runs; dotted where runs are missing.

    `window`: points over which lines and bands are averaged, which the figure then says.
    """
    figure = go.Figure()
    kinds = sorted({(g.preset, g.variant) for g in groups})
    presets = len({preset for preset, _ in kinds})
    drawn: list[tuple[NDArray, NDArray]] = []
    for group in groups:
        smooth = smoothed(group, window)
        drawn.append((smooth.step, smooth.mean))
        if singles and group.n > 1:
            drawn += [(curve.step, curve.value) for curve in group.curves]
            figure.add_traces([_single(curve, axes) for curve in group.curves])
        if np.isfinite(group.low).any():
            figure.add_trace(_band(smooth))
        dash = DASHES[kinds.index((group.preset, group.variant)) % len(DASHES)]
        name = group_name(group, several_presets=presets > 1)
        figure.add_traces(_middle(smooth, name, dash, axes))
    _draw_axes(figure, metric, height, axes, [group.env for group in groups])
    words = [f"smoothed: mean of {window} points of the line"] if window > 1 else []
    if any(group.thinned for group in groups):
        words.append(f"thinned to {GRID} points a line")
    if singles and any(len(c.step) > POINTS for g in groups if g.n > 1 for c in g.curves):
        words.append(f"single runs thinned to {POINTS} points each")
    cut_bands(figure, log_x=axes.log_x, log_y=axes.log_y)
    words += left_out(drawn, log_x=axes.log_x, log_y=axes.log_y)
    return note(figure, "<br>".join(words)) if words else figure


def group_name(group: Group, *, several_presets: bool = False) -> str:
    """`TOM (n = 3)`; the preset and other settings too where they set groups apart."""
    preset = f", {group.preset}" if several_presets else ""
    variant = f", {group.variant}" if group.variant else ""
    count = f"n = {group.n}" if group.n > 1 else "1 seed, no band"
    return f"{learner_label(group.learner)}{preset}{variant} ({count})"


def _identity(group: Group | Curve) -> str:
    return text.plotly(f"{group.env} {group.learner} {group.preset} {group.variant}")


def _draw_axes(
    figure: go.Figure, metric: str, height: int, axes: Axes, envs: Sequence[str]
) -> None:
    x = steps_in_words(envs) if axes.x == ENV_STEPS else axes.x
    styled(figure, x, height, keep=f"{metric} {axes}")
    figure.update_xaxes(type="log" if axes.log_x else "linear")
    figure.update_yaxes(type="log" if axes.log_y else "linear")
    lines: list[Any] = list(figure.data)
    places = {float(x) for line in lines for x in line.x[:2]}
    if len(places) == 1 and not axes.log_x:
        # One evaluation so far: where it lies says more than a thousandth to either side of it.
        figure.update_xaxes(rangemode="tozero", autorangeoptions={"include": 0})


def _single(curve: Curve, axes: Axes) -> go.Scatter:
    step, value, _ = decimate(curve.step, curve.value, POINTS)
    return go.Scatter(
        x=step,
        y=value,
        uid=curve.run_id,
        name=text.plotly(curve.run_id),
        meta=curve.run_id,
        mode="lines",
        line={"color": learner_colour(curve.learner), "width": 1},
        opacity=0.35,
        hovertemplate=_hover(curve, axes.x),
        legendgroup=_identity(curve),
        showlegend=False,
    )


def _band(group: Group) -> go.Scatter:
    here = np.isfinite(group.low)
    step = group.step[here]
    return go.Scatter(
        x=np.concatenate([step, step[::-1]]),
        y=np.concatenate([group.high[here], group.low[here][::-1]]),
        uid=f"{_identity(group)} band",
        name="band",
        fill="toself",
        fillcolor=faded(learner_colour(group.learner), 0.18),
        line={"width": 0},
        mode="lines",
        hoverinfo="skip",
        legendgroup=_identity(group),
        showlegend=False,
    )


def _middle(group: Group, name: str, dash: str, axes: Axes) -> list[go.Scatter]:
    full = group.complete
    parts = [go.Scatter(x=group.step[full], y=group.mean[full], customdata=group.count[full])]
    if not full.all():
        # Joined to the solid part, so that the eye sees one line that gets less certain.
        value = np.where(_beside(~full), group.mean, np.nan)
        parts.append(go.Scatter(x=group.step, y=value, customdata=group.count))
    marked = len(group.step) < 40 and not group.interpolated
    statistic = {"mean": "mean", "median": "median", "iqm": "IQM"}[group.statistic]
    for i, part in enumerate(parts):
        part.update(
            uid=f"{_identity(group)} {'line' if i == 0 else 'dots'}",
            name=text.plotly(name) if i == 0 else "fewer runs than n",
            meta=group.curves[0].run_id if group.n == 1 else None,
            mode="lines+markers" if marked and i == 0 else "lines",
            line={
                "color": learner_colour(group.learner),
                "width": 2.6 if i == 0 else 1.6,
                "dash": dash if i == 0 else "dot",
            },
            marker={"size": 6, "symbol": learner_symbol(group.learner)},
            hovertemplate=f"<b>{text.plotly(learner_label(group.learner))}</b> {statistic}, "
            f"n = %{{customdata}}<br>{_at(axes.x)}: %{{y:.4g}}<extra></extra>",
            legendgroup=_identity(group),
            showlegend=i == 0,
        )
    return parts


def _beside(here: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """True (T,) where `here` is, and on either side of it."""
    wider = here.copy()
    wider[1:] |= here[:-1]
    wider[:-1] |= here[1:]
    return wider


def _hover(curve: Curve, x: str = ENV_STEPS) -> str:
    name = f"{text.plotly(learner_label(curve.learner))}</b> seed {curve.seed}"
    return f"<b>{name}<br>{text.plotly(curve.run_id)}<br>{_at(x)}: %{{y:.4g}}<extra></extra>"


def _at(x: str) -> str:
    return "%{x:,} steps" if x == ENV_STEPS else f"{text.plotly(x)} %{{x:.4g}}"
