"""The page's choices of a metric, its axis and its zoom, and how runs are put together."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import streamlit as st

from app.data import readers
from app.data.cache import get_or_make
from app.figures.curves import Axes
from app.parts import address
from app.parts.plot import Part, View
from tom.analysis.curves import Band, Curve, Group, Statistic, curve_of, groups, points_against
from tom.analysis.settings import Kind
from tom.record.reader import RunReader

STEPS, SHARE, WALL = "env steps", "share of the run", "wall time, minutes"
STATISTICS: dict[str, Statistic] = {"mean": "mean", "median": "median", "IQM": "iqm"}
BANDS: dict[str, Band] = {
    "95 % bootstrap": "bootstrap",
    "standard deviation": "deviation",
    "none": "none",
}
WINDOWS = (1, 3, 5, 9, 15, 25, 51, 101)
FIRST = ("eval/return", "exam/error", "exam/footprint", "weights/ess", "exam/rollout_error")
"""the metrics that users want most; they come before the others"""
IQM = "interquartile mean: the mean of the middle half of the runs; of fewer than four the mean"
ZOOM = "zoom"


@dataclass(frozen=True)
class Measure:
    axes: Axes
    statistic: Statistic
    band: Band
    window: int
    singles: bool


def choose(names: Sequence[str]) -> Measure:
    """The controls of curves, whose runs have recorded these metrics."""
    statistic = address.choose_one(
        st.segmented_control, "Over runs", list(STATISTICS), "statistic", "mean", required=True,
        help=IQM,
    )  # fmt: skip
    band = address.choose_one(st.selectbox, "Band", list(BANDS), "band", next(iter(BANDS)))
    x = address.choose_one(
        st.selectbox, "Along", [STEPS, SHARE, WALL, *names], "x", STEPS,
        help="env steps, the share of each run that is done, its own wall time, or any metric",
    )  # fmt: skip
    window = address.choose_one(
        st.select_slider, "Smoothing", WINDOWS, "smoothing", 1,
        lambda points: "none" if points == 1 else f"{points} points",
        help="moving average of the lines and bands, after the runs are combined",
    )  # fmt: skip
    row = st.columns(3)
    with row[0]:
        log_x = address.switch("log x", "logx")
    with row[1]:
        log_y = address.switch("log y", "logy")
    with row[2]:
        singles = address.switch("single runs", "singles")
    axes = Axes(x, log_x, log_y)
    return Measure(axes, STATISTICS[statistic], BANDS[band], int(window), singles)


def favourites_first(names: Iterable[str]) -> list[str]:
    """The distinct metrics of runs by name, those of `FIRST` in front."""
    metrics = set(names) - {"env_step"}
    first = [name for name in FIRST if name in metrics]
    return [*first, *sorted(metrics.difference(first))]


def grouped(
    runs: Sequence[RunReader],
    kinds: Mapping[str, Kind],
    metric: str,
    x: str = STEPS,
    statistic: Statistic = "mean",
    band: Band = "bootstrap",
) -> tuple[list[Curve], list[Group]]:
    """The curves of the runs, and their groups by `kinds`; none if they cannot be put together."""

    def make() -> tuple[list[Curve], list[Group]]:
        curves = [curve(run, metric, x, kinds[run.run_id]) for run in runs]
        advancing = all((np.diff(one.step) > 0).all() for one in curves)
        return curves, groups(curves, statistic, band) if advancing else []

    return get_or_make(("groups", cache_key(runs, kinds), metric, x, statistic, band), None, make)


def cache_key(runs: Sequence[RunReader], kinds: Mapping[str, Kind]) -> tuple[object, ...]:
    """What the curves and groups of runs depend on, for the key of a cache."""
    return tuple(
        (
            run.path, run.status.total, run.status.alive, readers.metrics_version(run),
            kinds[run.run_id],
        )
        for run in runs
    )  # fmt: skip


def curve(run: RunReader, metric: str, x: str, kind: Kind) -> Curve:
    """The metric of one run along the axis, in the order it was recorded."""
    frame = readers.metrics(run)
    made = replace(curve_of(run, frame, metric), variant=kind.variant, group=kind)
    if x == SHARE:
        return replace(made, step=made.step / max(run.status.total, 1))
    if x == STEPS:
        return made
    step, value = points_against(frame, metric, "time/wall_s" if x == WALL else x)
    return replace(made, step=step / 60 if x == WALL else step, value=value)


def has_repeated_seed(grouped: Sequence[Group]) -> bool:
    """Whether a seed was run twice in a group."""
    return any(len({curve.seed for curve in group.curves}) < group.n for group in grouped)


def zoom(measured: object) -> dict[str, Part]:
    """The shown part of each y axis by its metric, and of the x axis of all by the empty name.

    In the address as `zoom=~0~50000` and `zoom=eval/return~-100~3000`. A zoom belongs to what was
    `measured` and is dropped when that changes.
    """
    seen = address.value_of(ZOOM, parse_zoom, measured)
    address.write(ZOOM, [f"{name}~{low:.5g}~{high:.5g}" for name, (low, high) in seen.items()])
    return seen


def parse_zoom(words: Sequence[str]) -> dict[str, Part]:
    """The parts that the words of an address name; malformed words are left out."""
    seen = {}
    for word in words:
        name, *ends = word.rsplit("~", 2)
        try:
            low, high = map(float, ends)
        except ValueError:
            continue
        if math.isfinite(low) and math.isfinite(high) and low < high:
            seen[name] = low, high
    return seen


def set_zoom(seen: Mapping[str, Part], metric: str, shown: View) -> None:
    """Show this part of a metric's panel from now on, and the same x axis in all others."""
    changed = {name: part for name, part in seen.items() if name not in ("", metric)}
    changed |= {name: part for name, part in (("", shown.x), (metric, shown.y)) if part}
    st.session_state[ZOOM] = changed
