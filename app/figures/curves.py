"""Metrics against env steps or another axis: single runs, and groups with their band."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from hashlib import blake2b
from typing import Any

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray

from app import text
from app.figures.base import (
    ENV_STEPS,
    ROW,
    band,
    dashes,
    legend_rows,
    note,
    steps_in_words,
    styled,
)
from app.figures.lines import cut_bands, decimate, left_out
from app.figures.looks import Look
from app.figures.looks import looks as usual_looks
from app.theme import learner_colour, learner_label, learner_symbol
from tom.analysis.curves import GRID, Curve, Group, smoothed
from tom.analysis.grouping import Kind

POINTS = 1500
"""maximum number of points of a line; the figure says if points were left out"""
ROWS = 2
"""rows of the legend that a figure's height has room for"""
LONGEST = 40
"""maximum number of characters of a group's title in the hover text"""


@dataclass(frozen=True)
class Axes:
    """How the figure's axes are drawn."""

    x: str = ENV_STEPS
    log_x: bool = False
    log_y: bool = False


PLAIN = Axes()


SHORT_TITLES = {
    "eval/return": "Return",
    "eval/return_max": "Best return so far",
    "exam/error": "Model error where the policy goes",
    "exam/rollout_error": "Model error, five steps ahead",
    "exam/footprint": "Footprint: distance to the policy",
    "weights/ess": "Effective sample",
    "model/holdout_nll": "Model's loss on held-out rows",
}


def short_title(metric: str) -> str:
    """What a metric is called above its figure; its path if it has no name of its own."""
    return SHORT_TITLES.get(metric, metric)


def run_curves(
    curves: Sequence[Curve],
    metric: str,
    height: int,
    *,
    legend: bool,
    axes: Axes = PLAIN,
    looks: Mapping[Kind, Look] | None = None,
    keep: str = "",
    called: Mapping[str, str] | None = None,
) -> go.Figure:
    """One line per run, coloured by learner; the runs of one learner differ in their dashes.

    With `looks`, colours and dashes are those of the runs' groups instead. `called` are the runs'
    names in the legend, by id, where learner and seed do not tell them apart. A zoom lasts while
    the metric, the axes and `keep`, which names the runs, are the same.
    """
    figure = go.Figure()
    words = []
    usual = dashes([curve.learner for curve in curves])
    for curve, dash in zip(curves, usual, strict=True):
        look = looks[curve.kind] if looks else None
        plain = f"{learner_label(curve.learner)} s{curve.seed}"
        step, value, cut = decimate(curve.step, curve.value, POINTS)
        if cut:
            words = [f"thinned to {POINTS} points a line"]
        figure.add_trace(
            go.Scatter(
                x=step,
                y=value,
                uid=line_uid(curve),
                name=text.plotly((called or {}).get(curve.run_id, plain)),
                meta=curve.run_id,
                mode="lines+markers" if len(step) < 40 else "lines",
                line={
                    "color": look.colour if look else learner_colour(curve.learner),
                    "width": 2,
                    "dash": look.dash if look else dash,
                },
                marker={"size": 5, "symbol": learner_symbol(curve.learner)},
                hovertemplate=_hover(curve, axes.x),
                showlegend=legend,
            )
        )
    _draw_axes(figure, metric, height, axes, [curve.env for curve in curves], keep)
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
    looks: Mapping[Kind, Look] | None = None,
    hidden: Collection[Kind] = (),
    width: int = 0,
) -> go.Figure:
    """One line per group with its band, thin lines for single runs, dots if runs are missing.

    Lines and bands are averaged over `window` points, and the figure says so. `looks` are those of
    all groups of a comparison, also of those in other figures. `hidden` groups appear only in the
    legend. A figure that is at least `width` pixels wide is higher by the legend's rows beyond
    `ROWS`, which would else take the lines' room; 0: no higher.
    """
    figure = go.Figure()
    drawn: list[tuple[NDArray, NDArray]] = []
    looks = looks or usual_looks((group.env, group.kind) for group in groups)
    for group in groups:
        smooth, look = smoothed(group, window), looks[group.kind]
        traces = []
        if singles and group.n > 1:
            traces += [_single(curve, look) for curve in group.curves]
        if np.isfinite(group.low).any():
            traces.append(_band(smooth, look))
        count = f"n = {group.n}" if group.n > 1 else "1 seed, no band"
        traces += _middle(smooth, f"{look.title} ({count})", look)
        if group.kind in hidden:
            figure.add_traces([trace.update(visible="legendonly") for trace in traces])
            continue
        figure.add_traces(traces)
        drawn.append((smooth.step, smooth.mean))
        if singles and group.n > 1:
            drawn += [(curve.step, curve.value) for curve in group.curves]
    if width:
        height += _rows_beyond(figure, width) * ROW
    _draw_axes(figure, metric, height, axes, [group.env for group in groups])
    words = [f"smoothed: mean of {window} points of the line"] if window > 1 else []
    if any(group.thinned for group in groups):
        words.append(f"thinned to {GRID} points a line")
    if singles and any(len(c.step) > POINTS for g in groups if g.n > 1 for c in g.curves):
        words.append(f"single runs thinned to {POINTS} points each")
    # One label for all lines at a step, the highest first.
    figure.update_layout(hovermode="x unified", hoversort="value descending")
    cut_bands(figure, log_x=axes.log_x, log_y=axes.log_y)
    words += left_out(drawn, log_x=axes.log_x, log_y=axes.log_y)
    return note(figure, "<br>".join(words)) if words else figure


def _rows_beyond(figure: go.Figure, width: int) -> int:
    traces: list[Any] = list(figure.data)
    return max(0, legend_rows((trace.name for trace in traces if trace.showlegend), width) - ROWS)


def _identity(group: Group | Curve, part: str = "") -> str:
    return _identifier(group.env, *group.kind, part)


def _identifier(*words: str) -> str:
    """A name for these words that Plotly can make a CSS class of, whatever they are."""
    return blake2b("\n".join(words).encode(), digest_size=8).hexdigest()


def _draw_axes(
    figure: go.Figure, metric: str, height: int, axes: Axes, envs: Sequence[str], keep: str = ""
) -> None:
    x = steps_in_words(envs) if axes.x == ENV_STEPS else text.plotly(axes.x)
    styled(figure, x, height, keep=f"{metric} {axes} {keep}")
    figure.update_layout(meta={"y": short_title(metric)})  # for a saved figure: pages have titles
    figure.update_xaxes(type="log" if axes.log_x else "linear")
    figure.update_yaxes(type="log" if axes.log_y else "linear")
    lines: list[Any] = list(figure.data)
    places = {float(x) for line in lines for x in line.x[:2]}
    if len(places) == 1 and not axes.log_x:
        # With a single point Plotly would show a tiny range around it: start the axis at zero.
        figure.update_xaxes(rangemode="tozero", autorangeoptions={"include": 0})


def _single(curve: Curve, look: Look) -> go.Scatter:
    step, value, _ = decimate(curve.step, curve.value, POINTS)
    return go.Scatter(
        x=step,
        y=value,
        uid=line_uid(curve),
        name=text.plotly(curve.run_id),
        meta=curve.run_id,
        mode="lines",
        line={"color": look.colour, "width": 1},
        opacity=0.35,
        hovertemplate=f"{text.plotly(learner_label(curve.learner))} s{curve.seed}: %{{y:.4g}}"
        "<extra></extra>",
        legendgroup=_identity(curve),
        showlegend=False,
    )


def _band(group: Group, look: Look) -> go.Scatter:
    here = np.isfinite(group.low)
    ends = group.low[here], group.high[here]
    drawn = band(group.step[here], *ends, look.colour, _identity(group))
    return drawn.update(uid=_identity(group, "band"), name=f"{text.plotly(look.title)}, band")


def _middle(group: Group, name: str, look: Look) -> list[go.Scatter]:
    full = group.complete
    parts: list[tuple[go.Scatter, bool]] = []
    if full.any():  # the legend leaves out a line without points
        solid = go.Scatter(x=group.step[full], y=group.mean[full], customdata=group.count[full])
        parts.append((solid, True))
    if not full.all():
        # Joined to the solid part, so that both look like one line.
        value = np.where(_beside(~full), group.mean, np.nan)
        parts.append((go.Scatter(x=group.step, y=value, customdata=group.count), False))
    only = group.curves[0].run_id if group.curves else None
    marked = len(group.step) < 40 and not group.interpolated
    statistic = {"mean": "mean", "median": "median", "iqm": "IQM"}[group.statistic]
    for i, (part, whole) in enumerate(parts):
        part.update(
            uid=line_uid(group) if i == 0 else _identity(group, "dots"),
            name=text.plotly(name) if i == 0 else "fewer runs than n",
            meta=[curve.run_id for curve in group.curves] if group.n > 1 else only,
            mode="lines+markers" if marked and whole else "lines",
            line={
                "color": look.colour,
                "width": 2.6 if whole else 1.6,
                "dash": look.dash if whole else "dot",
            },
            marker={"size": 6, "symbol": look.symbol},
            hovertemplate=f"<b>{text.plotly(_short(look.title))}</b> {statistic}, "
            "n = %{customdata}: %{y:.4g}<extra></extra>",
            legendgroup=_identity(group),
            showlegend=i == 0,
        )
    return [part for part, _ in parts]


def _short(title: str) -> str:
    return title if len(title) <= LONGEST else f"{title[: LONGEST - 3]}..."


def line_uid(of: Group | Curve) -> str:
    """The `uid` of a group's or a run's line in a chart."""
    return _identity(of, "line") if isinstance(of, Group) else _identifier(of.run_id)


def _beside(here: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """A mask (T,) of the places in `here` and their neighbours on either side."""
    wider = here.copy()
    wider[1:] |= here[:-1]
    wider[:-1] |= here[1:]
    return wider


def _hover(curve: Curve, x: str = ENV_STEPS) -> str:
    name = f"{text.plotly(learner_label(curve.learner))}</b> seed {curve.seed}"
    return f"<b>{name}<br>{text.plotly(curve.run_id)}<br>{_at(x)}: %{{y:.4g}}<extra></extra>"


def _at(x: str) -> str:
    return "%{x:,} steps" if x == ENV_STEPS else f"{text.plotly(x)} %{{x:.4g}}"
