"""Metrics against env steps: single runs, and groups with mean and band."""

from collections.abc import Sequence

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray

from app import text
from app.aggregate import Curve, Group, decimate
from app.figures.base import DASHES, note, styled
from app.theme import faded, learner_colour, learner_label, learner_symbol
from tom.metrics import describe

POINTS = 1500
"""points of a line at most; what is left out is said on the figure"""


def metric_title(metric: str) -> str:
    """A metric's path, its words in brackets where the table has some."""
    words = describe(metric)
    return metric if words == metric else f"{metric}: {words}"


def run_curves(curves: Sequence[Curve], metric: str, height: int, *, legend: bool) -> go.Figure:
    """One line a run, coloured by learner; the runs of one learner differ in their dashes."""
    figure = go.Figure()
    thinned = False
    learners = [curve.learner for curve in curves]
    for i, curve in enumerate(curves):
        step, value, cut = decimate(curve.step, curve.value, POINTS)
        thinned |= cut
        figure.add_trace(
            go.Scatter(
                x=step,
                y=value,
                name=text.plotly(f"{learner_label(curve.learner)} s{curve.seed}"),
                meta=curve.run_id,
                mode="lines+markers" if len(step) < 40 else "lines",
                line={
                    "color": learner_colour(curve.learner),
                    "width": 2,
                    "dash": DASHES[learners[:i].count(curve.learner) % len(DASHES)],
                },
                marker={"size": 5, "symbol": learner_symbol(curve.learner)},
                hovertemplate=_hover(curve),
                showlegend=legend,
            )
        )
    styled(figure, "env steps", height, keep=metric)
    return note(figure, f"thinned to {POINTS} points a line") if thinned else figure


def group_curves(groups: Sequence[Group], metric: str, height: int, *, singles: bool) -> go.Figure:
    """Mean over seeds with its band; thin lines for single runs; dotted where runs are missing."""
    figure = go.Figure()
    presets = sorted({g.preset for g in groups})
    for group in groups:
        if singles and group.n > 1:
            for curve in group.curves:
                figure.add_trace(_single(curve))
        if group.n > 1:
            figure.add_trace(_band(group))
        dash = DASHES[presets.index(group.preset) % len(DASHES)]
        figure.add_traces(_mean(group, group_name(group, several_presets=len(presets) > 1), dash))
    return styled(figure, "env steps", height, keep=metric)


def group_name(group: Group, *, several_presets: bool = False) -> str:
    """`TOM (n = 3)`; the preset too where there are several."""
    preset = f", {group.preset}" if several_presets else ""
    count = f"n = {group.n}" if group.n > 1 else "1 seed, no band"
    return f"{learner_label(group.learner)}{preset} ({count})"


def _single(curve: Curve) -> go.Scatter:
    step, value, _ = decimate(curve.step, curve.value, POINTS)
    return go.Scatter(
        x=step,
        y=value,
        name=text.plotly(curve.run_id),
        meta=curve.run_id,
        mode="lines",
        line={"color": learner_colour(curve.learner), "width": 1},
        opacity=0.35,
        hovertemplate=_hover(curve),
        legendgroup=text.plotly(f"{curve.learner} {curve.preset}"),
        showlegend=False,
    )


def _band(group: Group) -> go.Scatter:
    here = np.isfinite(group.low)
    step = group.step[here]
    return go.Scatter(
        x=np.concatenate([step, step[::-1]]),
        y=np.concatenate([group.high[here], group.low[here][::-1]]),
        name="95 % band",
        fill="toself",
        fillcolor=faded(learner_colour(group.learner), 0.18),
        line={"width": 0},
        mode="lines",
        hoverinfo="skip",
        legendgroup=text.plotly(f"{group.learner} {group.preset}"),
        showlegend=False,
    )


def _mean(group: Group, name: str, dash: str) -> list[go.Scatter]:
    full = group.complete
    parts = [go.Scatter(x=group.step[full], y=group.mean[full], customdata=group.count[full])]
    if not full.all():
        # Joined to the solid part, so that the eye sees one line that gets less certain.
        value = np.where(_beside(~full), group.mean, np.nan)
        parts.append(go.Scatter(x=group.step, y=value, customdata=group.count))
    marked = len(group.step) < 40 and not group.interpolated
    for i, part in enumerate(parts):
        part.update(
            name=text.plotly(name) if i == 0 else "fewer runs than n",
            mode="lines+markers" if marked and i == 0 else "lines",
            line={
                "color": learner_colour(group.learner),
                "width": 2.6 if i == 0 else 1.6,
                "dash": dash if i == 0 else "dot",
            },
            marker={"size": 6, "symbol": learner_symbol(group.learner)},
            hovertemplate=f"<b>{text.plotly(learner_label(group.learner))}</b> mean of "
            "%{customdata} runs<br>%{x:,} steps: %{y:.4g}<extra></extra>",
            legendgroup=text.plotly(f"{group.learner} {group.preset}"),
            showlegend=i == 0,
        )
    return parts


def _beside(here: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """True (T,) where `here` is, and on either side of it."""
    wider = here.copy()
    wider[1:] |= here[:-1]
    wider[:-1] |= here[1:]
    return wider


def _hover(curve: Curve) -> str:
    name = f"{text.plotly(learner_label(curve.learner))}</b> seed {curve.seed}"
    return f"<b>{name}<br>{text.plotly(curve.run_id)}<br>%{{x:,}} steps: %{{y:.4g}}<extra></extra>"
