"""Metrics against env steps or another axis: single runs, and groups with their looks and bands."""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from hashlib import blake2b
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
    dashes,
    decimate,
    left_out,
    line,
    note,
    steps_in_words,
    styled,
)
from app.theme import (
    NEUTRAL,
    QUALITATIVE,
    SYMBOLS,
    Mode,
    learner_colour,
    learner_label,
    learner_symbol,
    mixed,
    ramp,
    shades,
)
from tom.analysis.curves import GRID, Curve, Group, smoothed
from tom.analysis.settings import USUAL, Kind, natural, number
from tom.envs import ROAD
from tom.learners import SUBJECT

POINTS = 1500
"""maximum number of points of a line; the figure says if points were left out"""
HOLLOW = 4.2
"""the width of a hollow line"""
CORE = "core"
"""the name of the traces that are the insides of hollow lines"""
LONGEST = 40
"""maximum number of characters of a group's title in the hover text"""


@dataclass(frozen=True)
class Look:
    """The title and style of a group, the same in every figure."""

    title: str
    colour: str
    dash: str
    symbol: str
    core: str = ""
    """the paler colour inside a line that is hollow; its edge has the `colour`"""


def looks_of(
    groups: Iterable[tuple[str, Kind]], by: str = USUAL, mode: Mode = "light"
) -> dict[Kind, Look]:
    """The look of every kind among the groups, which are pairs (environment, kind).

    A learner has its own hue, each of its groups a shade of it. Grouped by a setting, each value
    has its own colour, in order if the values are numbers; groups of learners without that setting
    are grey.
    """
    groups = set(groups)
    tasks = Counter(kind for _, kind in groups)
    offline = {kind for env, kind in groups if env == ROAD}  # where the paper's is the main preset
    learnt = sorted(kind for kind in tasks if kind.learner)
    if by in (USUAL, "learner"):
        return {
            kind: _look(
                kind, _title(kind, tasks), "paper" if kind in offline else main_preset(kind.learner)
            )
            for kind in sorted(tasks)
        }
    values = sorted((kind for kind in tasks if not kind.learner), key=_order)
    # Seeds are numbers without a meaning.
    ordered = by != "seed" and all(number(kind, by) is not None for kind in values)
    colours = ramp(len(values), mode) if ordered else QUALITATIVE
    of_values = {
        kind: Look(
            _title(kind, values),
            colours[i % len(colours)],
            DASHES[i // len(colours) % len(DASHES)],
            SYMBOLS[i % len(SYMBOLS)],
        )
        for i, kind in enumerate(values)
    }
    grey = {
        kind: Look(
            _title(kind, learnt), NEUTRAL, DASHES[i % len(DASHES)], learner_symbol(kind.learner)
        )
        for i, kind in enumerate(learnt)
    }
    return of_values | grey


def _title(kind: Kind, among: Iterable[Kind]) -> str:
    """The learner, such as `TOM`, then the preset if its learner has several, and the settings."""
    presets = {other.preset for other in among if other.learner == kind.learner}
    preset = kind.preset if len(presets) > 1 or not kind.learner else ""
    called = " ".join(filter(None, (learner_label(kind.learner), preset)))
    return ", ".join(filter(None, (called, kind.variant)))


def main_preset(learner: str) -> str:
    """The preset whose groups have a learner's full colour."""
    return "mended" if learner == SUBJECT else "paper"


def _look(kind: Kind, title: str, main: str) -> Look:
    """A group's look: the hue of its learner, and a pale core unless it is of the `main` preset.

    It depends on nothing but the group itself, so that no filter changes it.
    """
    colour = learner_colour(kind.learner)
    if kind.variant:
        grey = shades(mixed(colour, NEUTRAL, 0.5))
        colour = grey[blake2b(kind.variant.encode(), digest_size=1).digest()[0] * len(grey) // 256]
    core = "" if kind.preset in ("", main, "smoke") else mixed(colour, "#ffffff", 0.6)
    return Look(title, colour, "solid", learner_symbol(kind.learner), core)


def _order(kind: Kind) -> list[tuple[float, str]]:
    return natural(" ".join(kind))


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
            line(
                step,
                value,
                look.colour if look else learner_colour(curve.learner),
                2,
                _hover(curve, axes.x),
                dash=look.dash if look else dash,
                uid=line_uid(curve),
                name=text.plotly((called or {}).get(curve.run_id, plain)),
                meta=curve.run_id,
                mode="lines+markers" if len(step) < 40 else "lines",
                marker={"size": 5, "symbol": learner_symbol(curve.learner)},
                showlegend=legend,
            )
        )
    _draw_axes(figure, metric, height, axes, [curve.env for curve in curves], keep)
    words += left_out([(c.step, c.value) for c in curves], log_x=axes.log_x, log_y=axes.log_y)
    return note(figure, words)


def group_curves(
    groups: Sequence[Group],
    metric: str,
    height: int,
    *,
    singles: bool,
    axes: Axes = PLAIN,
    window: int = 1,
    looks: Mapping[Kind, Look] | None = None,
) -> go.Figure:
    """One line per group with its band, thin lines for single runs, dots if runs are missing.

    Lines and bands are averaged over `window` points, and the figure says so. `looks` are those of
    all groups of a comparison, also of those in other figures.
    """
    figure = go.Figure()
    drawn: list[tuple[NDArray, NDArray]] = []
    styles = looks or looks_of((group.env, group.kind) for group in groups)
    for group in groups:
        smooth, look = smoothed(group, window), styles[group.kind]
        traces = []
        if singles and group.n > 1:
            traces += [_single(curve, look) for curve in group.curves]
        if (here := np.isfinite(group.low)).any():
            ends = smooth.step[here], smooth.low[here], smooth.high[here]
            drawn_band = band(*ends, look.core or look.colour, _identity(smooth))
            traces.append(drawn_band.update(uid=_identity(smooth, "band"), name="band"))
        count = f"n = {group.n}" if group.n > 1 else "1 seed, no band"
        traces += _middle(smooth, f"{look.title} ({count})", look)
        figure.add_traces(traces)
        drawn.append((smooth.step, smooth.mean))
        if singles and group.n > 1:
            drawn += [(curve.step, curve.value) for curve in group.curves]
    _draw_axes(figure, metric, height, axes, [group.env for group in groups])
    words = [f"smoothed: mean of {window} points of the line"] if window > 1 else []
    if any(group.thinned for group in groups):
        words.append(f"thinned to {GRID} points a line")
    if singles and any(len(c.step) > POINTS for g in groups if g.n > 1 for c in g.curves):
        words.append(f"single runs thinned to {POINTS} points each")
    named = {
        _identity(one): [text.plotly(styles[one.kind].title), text.plotly(one.kind.preset)]
        for one in groups
    }
    # One label for all lines at a step, the highest first.
    figure.update_layout(
        hovermode="x unified", hoversort="value descending",
        meta={"y": short_title(metric), "groups": named},  # for a saved table
    )  # fmt: skip
    cut_bands(figure, log_x=axes.log_x, log_y=axes.log_y)
    words += left_out(drawn, log_x=axes.log_x, log_y=axes.log_y)
    return note(figure, words)


def _identity(group: Group | Curve, part: str = "") -> str:
    return _identifier(group.env, *group.kind, part)


def _identifier(*words: str) -> str:
    """A name for these words that Plotly can make a CSS class of, whatever they are."""
    return blake2b("\n".join(words).encode(), digest_size=8).hexdigest()


def _draw_axes(
    figure: go.Figure, metric: str, height: int, axes: Axes, envs: Sequence[str], keep: str = ""
) -> None:
    x = steps_in_words(envs) if axes.x == ENV_STEPS else text.plotly(axes.x)
    lines: list[Any] = list(figure.data)
    x_axis: dict[str, Any] = {"type": "log" if axes.log_x else "linear"}
    if len({float(x) for trace in lines for x in trace.x[:2]}) == 1 and not axes.log_x:
        # With a single point Plotly would show a tiny range around it: start the axis at zero.
        x_axis |= {"rangemode": "tozero", "autorangeoptions": {"include": 0}}
    y_axis = {"type": "log" if axes.log_y else "linear"}
    kept = f"{metric} {axes} {keep}"
    styled(figure, x, height, keep=kept, x_axis=x_axis, y_axis=y_axis)
    figure.update_layout(meta={"y": short_title(metric)})  # for a saved figure: pages have titles


def _single(curve: Curve, look: Look) -> go.Scatter:
    step, value, _ = decimate(curve.step, curve.value, POINTS)
    name = f"{text.plotly(learner_label(curve.learner))} s{curve.seed}"
    return line(
        step,
        value,
        look.colour,
        1,
        f"{name}: %{{y:.4g}}<extra></extra>",
        uid=line_uid(curve),
        name=text.plotly(curve.run_id),
        meta=curve.run_id,
        opacity=0.35,
        legendgroup=_identity(curve),
        showlegend=False,
    )


def _middle(group: Group, name: str, look: Look) -> list[go.Scatter]:
    """The line of a group: solid where all its runs are, and dotted elsewhere."""
    full = group.complete
    parts = []
    if full.any():  # the legend leaves out a line without points
        parts.append((full, group.mean[full], True))
    if not full.all():
        # Joined to the solid part, so that both look like one line.
        near = ~full | np.append(~full[1:], False) | np.append(False, ~full[:-1])
        parts.append((np.ones_like(full), np.where(near, group.mean, np.nan), False))
    only = group.curves[0].run_id if group.curves else None
    marked = len(group.step) < 40 and not group.interpolated
    statistic = {"mean": "mean", "median": "median", "iqm": "IQM"}[group.statistic]
    title = look.title if len(look.title) <= LONGEST else f"{look.title[: LONGEST - 3]}..."
    hover = f"<b>{text.plotly(title)}</b> {statistic}, n = %{{customdata}}: %{{y:.4g}}"
    lines = [
        line(
            group.step[here],
            value,
            look.colour,
            (HOLLOW if look.core else 2.6) if whole else 1.6,
            f"{hover}<extra></extra>",
            dash=look.dash if whole else "dot",
            customdata=group.count[here],
            uid=line_uid(group) if i == 0 else _identity(group, "dots"),
            name=text.plotly(name) if i == 0 else "fewer runs than n",
            meta=[curve.run_id for curve in group.curves] if group.n > 1 else only,
            mode="lines+markers" if marked and whole else "lines",
            marker={"size": 6, "symbol": look.symbol},
            legendgroup=_identity(group),
            showlegend=i == 0,
        )
        for i, (here, value, whole) in enumerate(parts)
    ]
    if look.core and full.any():
        inside = core(group.step[full], group.mean[full], look)
        inside.update(uid=_identity(group, "core"), meta=lines[0].meta)
        lines.append(inside.update(legendgroup=_identity(group)))
    return lines


def core(x: NDArray, y: NDArray, look: Look) -> go.Scatter:
    """The inside of a hollow line, drawn over it."""
    return line(x, y, look.core, HOLLOW - 2.4, None, hoverinfo="skip", showlegend=False, name=CORE)


def line_uid(of: Group | Curve) -> str:
    """The `uid` of a group's or a run's line in a chart."""
    return _identity(of, "line") if isinstance(of, Group) else _identifier(of.run_id)


def _hover(curve: Curve, x: str) -> str:
    name = f"{text.plotly(learner_label(curve.learner))}</b> seed {curve.seed}"
    at = "%{x:,} steps" if x == ENV_STEPS else f"{text.plotly(x)} %{{x:.4g}}"
    return f"<b>{name}<br>{text.plotly(curve.run_id)}<br>{at}: %{{y:.4g}}<extra></extra>"
