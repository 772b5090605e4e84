"""Metrics against env steps or another axis: groups of runs, with their styles and bands.

The lines of groups have names at their ends, in place of a legend.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from hashlib import blake2b
from itertools import cycle
from typing import Any

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray

from app import text
from app.figures.base import (
    DASHES,
    ENV_STEPS,
    band,
    cut_bands,
    decimate,
    dropped_by_log_axes,
    line,
    note,
    step_axis_title,
    styled,
)
from app.theme import (
    NEUTRAL,
    QUALITATIVE,
    SYMBOLS,
    Mode,
    learner_colour,
    learner_symbol,
    mix,
    ramp,
    shades,
)
from tom.analysis.curves import GRID, Curve, Group, smoothed
from tom.analysis.grouping import CUT_SHORT, titles_of
from tom.analysis.settings import USUAL, Kind, natural_sort_key, number
from tom.envs import ROAD
from tom.learners import SUBJECT, learner_label

POINTS = 1500
"""maximum number of points of a line; the figure says if points were left out"""
HOLLOW = 4.2
"""the width of a hollow line"""
CORE = "core"
"""the name of the traces that are the insides of hollow lines"""
LONGEST = 28
"""maximum number of characters of a group's title in the hover text and beside its line"""
MARK, HOLLOW_MARK = "\u25a0", "\u25a1"
GAP, LETTER, ROOM = 15, 6.4, 14
"""pixels: least distance of two labels, a letter, and the room around a label"""


@dataclass(frozen=True)
class Style:
    """The title and style of a group, the same in every figure."""

    title: str
    colour: str
    dash: str
    symbol: str
    core: str = ""
    """the paler colour inside a line that is hollow; its edge has the `colour`"""

    @property
    def short(self) -> str:
        """The title without its middle if it is long: its ends tell it apart."""
        begin, end = self.title[: LONGEST // 2 - 1], self.title[-LONGEST // 2 :]
        return self.title if len(self.title) <= LONGEST else f"{begin}\u2026{end}"


def styles_of(
    groups: Iterable[tuple[str, Kind]], by: str = USUAL, mode: Mode = "light"
) -> dict[Kind, Style]:
    """The style of every kind among the groups, which are pairs (environment, kind).

    A learner has its own hue, each of its groups a shade of it. Grouped by a setting, each value
    has its own colour, in order if the values are numbers; groups of learners without that setting
    are grey.
    """
    groups = set(groups)
    kinds = sorted({kind for _, kind in groups})
    titles = titles_of(kinds)
    if by in (USUAL, "learner"):
        offline = {kind for env, kind in groups if env == ROAD}  # where the paper's is the main one
        return {kind: _style(kind, titles[kind], kind in offline) for kind in kinds}
    values = [kind for kind in kinds if not kind.learner]
    values.sort(key=lambda kind: natural_sort_key(" ".join(kind)))
    # Seeds are numbers without a meaning.
    ordered = by != "seed" and all(number(kind, by) is not None for kind in values)
    colours = ramp(len(values), mode) if ordered else QUALITATIVE
    pairs = [(colour, dash) for dash in DASHES for colour in colours]
    styles = {
        kind: Style(titles[kind], *style, SYMBOLS[i % len(SYMBOLS)])
        for i, (kind, style) in enumerate(zip(values, cycle(pairs), strict=False))
    }
    learnt = [kind for kind in kinds if kind.learner]
    return styles | {
        kind: Style(titles[kind], NEUTRAL, dash, learner_symbol(kind.learner))
        for kind, dash in zip(learnt, cycle(DASHES), strict=False)
    }


def _style(kind: Kind, title: str, offline: bool) -> Style:
    """A group's style: the hue of its learner, and a pale core unless it is of the main preset.

    It depends on nothing but the group itself, so that no filter changes it.
    """
    main = "mended" if kind.learner == SUBJECT and not offline else "paper"
    colour = learner_colour(kind.learner)
    if kind.variant:
        grey = shades(mix(colour, NEUTRAL, 0.5))
        colour = grey[blake2b(kind.variant.encode(), digest_size=1).digest()[0] * len(grey) // 256]
    pale = {"": 0.0, main: 0.0, "smoke": 0.3}.get(kind.preset, 0.6)
    core = mix(colour, "#ffffff", pale) if pale else ""
    return Style(title, colour, "solid", learner_symbol(kind.learner), core)


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


def opens_until(groups: Sequence[Group]) -> float:
    """The step at which a figure of these groups ends until it is zoomed out.

    Half the runs of some group of several reach it, so that a single longer run does not leave the
    others a small part of the width; and so does every training that is running.
    """
    ends = [sorted(curve.step[-1] for curve in group.curves) for group in groups]
    several = [of[len(of) // 2] for of in ends if len(of) > 1]
    growing = [curve.step[-1] for group in groups for curve in group.curves if curve.growing]
    last = max(of[-1] for of in ends)
    until = max([*several, *growing], default=last)
    return float(until if until < CUT_SHORT * last else last)


def single_run_group(curve: Curve, name: str) -> Group:
    """A run as a group of its own, also where it goes to and fro along the x axis."""
    step, value, cut = decimate(curve.step, curve.value, POINTS)
    nothing, one = np.full(len(step), np.nan), np.ones(len(step), np.int64)
    return Group(
        curve.env, curve.learner, curve.preset, (curve,), step, value, nothing, nothing, one,
        variant=name, thinned=cut,
    )  # fmt: skip


def group_curves(
    groups: Sequence[Group],
    metric: str,
    height: int,
    *,
    singles: bool,
    axes: Axes = PLAIN,
    window: int = 1,
    styles: Mapping[Kind, Style] | None = None,
) -> go.Figure:
    """One line per group with its band, thin lines for single runs, dots if runs are missing.

    Lines and bands are averaged over `window` points, and the figure says so. `styles` are those of
    all groups of a comparison, also of those in other figures.
    """
    figure = go.Figure()
    drawn: list[tuple[NDArray, NDArray]] = []
    by_kind = styles or styles_of((group.env, group.kind) for group in groups)
    named: dict[str, list[str]] = {}
    for group in groups:
        smooth, style, key = (
            smoothed(group, window),
            by_kind[group.kind],
            _css_key(group.env, *group.kind),
        )
        named[key] = [text.plotly(style.title), text.plotly(group.kind.preset)]
        drawn.append((smooth.step, smooth.mean))
        if singles and group.n > 1:
            figure.add_traces([_run_line(curve, style, key) for curve in group.curves])
            drawn += [(curve.step, curve.value) for curve in group.curves]
        if (here := np.isfinite(group.low)).any():
            ends = smooth.step[here], smooth.low[here], smooth.high[here]
            around = band(*ends, style.core or style.colour, key)
            figure.add_trace(around.update(uid=f"{key}band", name="band"))
        figure.add_traces(_group_lines(smooth, style, key))
    x = step_axis_title(group.env for group in groups)
    x = x if axes.x == ENV_STEPS else text.plotly(axes.x)
    x_axis: dict[str, Any] = {"type": "log" if axes.log_x else "linear"}
    lines: list[Any] = list(figure.data)
    words = [f"smoothed: mean of {window} points of the line"] if window > 1 else []
    last = max(x[-1] for x, _ in drawn)
    if axes.x == ENV_STEPS and not axes.log_x and (until := opens_until(groups)) < last:
        x_axis["range"] = [min(x[0] for x, _ in drawn), until]
        words.append(f"double-click: all {last:,.0f} steps")
    if len({float(x) for trace in lines for x in trace.x[:2]}) == 1 and not axes.log_x:
        # With a single point Plotly would show a tiny range around it: start the axis at zero.
        x_axis |= {"rangemode": "tozero", "autorangeoptions": {"include": 0}}
    kept = " ".join([metric, str(axes), *sorted({group.env for group in groups})])
    # One label for all lines at a step, the highest first; `meta` is for a saved figure and table.
    styled(
        figure, x, height, keep=kept, x_axis=x_axis,
        y_axis={"type": "log" if axes.log_y else "linear"}, hovermode="x unified",
        hoversort="value descending", meta={"y": short_title(metric), "groups": named},
    )  # fmt: skip
    if any(group.thinned for group in groups):
        words.append(f"thinned to {GRID} points a line")
    if singles and any(len(c.step) > POINTS for g in groups if g.n > 1 for c in g.curves):
        words.append(f"single runs thinned to {POINTS} points each")
    cut_bands(figure, log_x=axes.log_x, log_y=axes.log_y)
    words += dropped_by_log_axes(drawn, log_x=axes.log_x, log_y=axes.log_y)
    return note(figure, words, above=True)


def _css_key(*words: str) -> str:
    """A name for these words that Plotly can make a CSS class of, whatever they are."""
    return blake2b("\n".join(words).encode(), digest_size=8).hexdigest()


def return_line(curve: Curve, **more: Any) -> tuple[go.Scatter, list[str]]:
    """A run's returns, in a figure of its own or beside its weights; that they are thinned."""
    step, value, cut = decimate(curve.step, curve.value, POINTS)
    hover = f"{text.plotly(curve.run_id)}<br>step %{{x:,}}<br>return %{{y:,.5~g}}<extra></extra>"
    marked = {"marker": {"size": 5, "symbol": learner_symbol(curve.learner)}}
    mode = "lines+markers" if len(step) < 60 else "lines"
    more = {"name": "return", "meta": curve.run_id, "mode": mode, "showlegend": False} | more
    drawn = line(step, value, learner_colour(curve.learner), 2, hover, **marked, **more)
    return drawn, [f"returns thinned to {POINTS} points a line"] if cut else []


def _run_line(curve: Curve, style: Style, key: str) -> go.Scatter:
    step, value, _ = decimate(curve.step, curve.value, POINTS)
    hover = f"{text.plotly(learner_label(curve.learner))} s{curve.seed}: %{{y:.4g}}<extra></extra>"
    return line(
        step,
        value,
        style.colour,
        1,
        hover,
        uid=_css_key(curve.run_id),
        name=text.plotly(curve.run_id),
        meta=curve.run_id,
        opacity=0.35,
        legendgroup=key,
        showlegend=False,
    )


def _group_lines(group: Group, style: Style, key: str) -> list[go.Scatter]:
    """The line of a group: solid where all its runs are, and dotted elsewhere."""
    full, runs = group.complete, [curve.run_id for curve in group.curves]
    count = f"n = {group.n}" if group.n > 1 else "1 seed, no band"
    parts = []
    if full.any():  # the legend leaves out a line without points
        parts.append((full, group.mean[full], True))
    if not full.all():
        # Joined to the solid part, so that both look like one line.
        near = ~full | np.append(~full[1:], False) | np.append(False, ~full[:-1])
        parts.append((np.ones_like(full), np.where(near, group.mean, np.nan), False))
    marked = len(group.step) < 40 and not group.interpolated
    statistic = {"mean": "mean", "median": "median", "iqm": "IQM"}[group.statistic]
    hover = f"<b>{text.plotly(style.short)}</b> {statistic}, n = %{{customdata}}: %{{y:.4g}}"
    lines = [
        line(
            group.step[here],
            value,
            style.colour,
            (HOLLOW if style.core else 2.6) if whole else 1.6,
            f"{hover}<extra></extra>",
            dash=style.dash if whole else "dot",
            customdata=group.count[here],
            uid=f"{key}line" if i == 0 else f"{key}dots",
            name=text.plotly(f"{style.title} ({count})") if i == 0 else "fewer runs than n",
            meta=runs if group.n > 1 else next(iter(runs), None),
            mode="lines+markers" if marked and whole else "lines",
            marker={"size": 6, "symbol": style.symbol},
            legendgroup=key,
            showlegend=i == 0,
        )
        for i, (here, value, whole) in enumerate(parts)
    ]
    if style.core and full.any():
        inside = core_line(group.step[full], group.mean[full], style)
        lines.append(inside.update(uid=f"{key}core", meta=lines[0].meta, legendgroup=key))
    return lines


def core_line(x: NDArray, y: NDArray, style: Style) -> go.Scatter:
    """The inside of a hollow line, drawn over it."""
    return line(x, y, style.core, HOLLOW - 2.4, None, hoverinfo="skip", showlegend=False, name=CORE)


def label_ends(
    figure: go.Figure, groups: Sequence[Group], styles: Mapping[Kind, Style], axes: Axes
) -> go.Figure:
    """Name every group's line at the right of the figure, at the height where it ends.

    Labels that would overlap are moved apart. The figure has its height already. Where a line ends
    at or below zero on a log axis, the legend stays.
    """
    until = (figure.layout.xaxis.range or [np.inf])[-1]  # type: ignore[attr-defined]
    ends = []
    for group in groups:
        known = np.isfinite(group.mean)
        shown = group.mean[known & (group.step <= until)]
        end = shown[-1] if len(shown) else group.mean[known][0]  # of a line that begins beyond
        ends.append((float(end), styles[group.kind], group.n))
    if axes.log_y and any(y <= 0 for y, _, _ in ends):
        return figure
    # The axis ends at the lowest and highest of what is drawn; so do the labels' places, in pixels.
    traces: list[Any] = list(figure.data)
    values = np.concatenate([np.asarray(t.y, np.float64) for t in traces if t.y is not None])
    values, ys = values[np.isfinite(values)], np.array([y for y, _, _ in ends])
    if axes.log_y:
        values, ys = np.log10(values[values > 0]), np.log10(ys)
    low, high = float(values.min()), float(values.max())
    span = (high - low) or 1.0
    pixels = (figure.layout.height or 300) - 60  # type: ignore[attr-defined]
    place = spread_apart((ys - low) / span * pixels, GAP)
    names = [f"{look.short} ({n})" for _, look, n in ends]
    for name, (_, style, _), at in zip(names, ends, place, strict=True):
        mark = HOLLOW_MARK if style.core else MARK
        figure.add_annotation(
            text=f'<span style="color:{style.colour}">{mark}</span> {text.plotly(name)}',
            x=1, xref="paper", xanchor="left", xshift=6,
            y=low + at / pixels * span, yref="y", yanchor="middle", showarrow=False,
            font={"size": 12},
        )  # fmt: skip
    longest = max(map(len, names))
    figure.update_layout(showlegend=False, margin={"r": round(LETTER * longest) + ROOM})
    return figure


def spread_apart(places: np.ndarray, gap: float) -> np.ndarray:
    """The places (n,), moved a little so that no two are nearer than `gap`."""
    order = np.argsort(places, kind="stable")
    moved = places[order].astype(np.float64)
    for _ in range(200):
        close = np.flatnonzero(np.diff(moved) < gap - 1e-6)
        if not len(close):
            break
        for i in close:
            lack = (gap - (moved[i + 1] - moved[i])) / 2
            moved[i], moved[i + 1] = moved[i] - lack, moved[i + 1] + lack
    result = np.empty(len(moved))
    result[order] = moved
    return result
