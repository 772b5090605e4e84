"""What is measured, along which axis, and how runs are put together: choices of the page."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import streamlit as st

from app.data import readers, settings
from app.data.aggregate import Band, Curve, Group, Statistic, curve_points, groups, points_against
from app.data.cache import VersionedCache
from app.data.readers import RunInfo
from app.figures.curves import Axes

RETURN, RUNNING_MAXIMUM, OTHER = "return", "running maximum", "another metric"
METRICS = {RETURN: "eval/return", RUNNING_MAXIMUM: "eval/return_max"}
STEPS, SHARE, WALL = "env steps", "share of the run", "wall time, minutes"
STATISTICS: dict[str, Statistic] = {"mean": "mean", "median": "median", "IQM": "iqm"}
BANDS: dict[str, Band] = {
    "95 % bootstrap": "bootstrap",
    "standard deviation": "deviation",
    "none": "none",
}
WINDOWS = (1, 3, 5, 9, 15, 25, 51, 101)
FIRST = ("exam/error", "exam/rollout_error", "exam/footprint")
"""what is asked for most, in front of the other metrics"""
IQM = "interquartile mean: the mean of the middle half of the runs; of fewer than four the mean"


_GROUPED: VersionedCache[tuple[list[Curve], list[Group]]] = VersionedCache(32)


@dataclass(frozen=True)
class Measure:
    """How the chosen runs are compared."""

    metric: str
    axes: Axes
    statistic: Statistic
    band: Band
    window: int
    singles: bool


def choose(runs: Sequence[RunInfo]) -> Measure:
    """Two rows of controls; what they say is in the address."""
    row = st.columns([4, 4, 3, 3], vertical_alignment="bottom")
    kind = row[0].segmented_control(
        "Measure", [*METRICS, OTHER], default=RETURN, required=True, key="measure",
        bind="query-params",
    )  # fmt: skip
    names = in_order(name for run in runs for name in readers.metrics(run).columns)
    other = row[1].selectbox(
        "Metric", names, key="metric", bind="query-params", disabled=kind != OTHER,
        help="any metric that these runs recorded",
    )  # fmt: skip
    statistic = row[2].segmented_control(
        "Over seeds", list(STATISTICS), default="mean", required=True, key="statistic",
        bind="query-params", help=IQM,
    )  # fmt: skip
    band = row[3].selectbox("Band", list(BANDS), key="band", bind="query-params")
    row = st.columns([4, 4, 2, 2, 2], vertical_alignment="bottom")
    x = row[0].selectbox(
        "Along", [STEPS, SHARE, WALL, *names], key="x", bind="query-params",
        help="env steps, the share of each run that is done, its own wall time, or any metric",
    )  # fmt: skip
    window = row[1].select_slider(
        "Smoothing", WINDOWS, 1, key="smoothing", bind="query-params",
        format_func=lambda points: "none" if points == 1 else f"{points} points",
        help="moving average of the lines and bands, after the runs were put together",
    )  # fmt: skip
    log_x = row[2].toggle("log x", key="logx", bind="query-params")
    log_y = row[3].toggle("log y", key="logy", bind="query-params")
    singles = row[4].toggle("single seeds", value=True, key="singles", bind="query-params")
    return Measure(
        METRICS.get(kind or RETURN) or other or "eval/return",
        Axes(x or STEPS, log_x, log_y),
        STATISTICS[statistic or "mean"],
        BANDS[band or "95 % bootstrap"],
        int(window),
        singles,
    )


def in_order(names: Iterable[str]) -> list[str]:
    """The metrics of runs by name, each once, those of `FIRST` in front."""
    found = set(names) - {"env_step"}
    first = [name for name in FIRST if name in found]
    return [*first, *sorted(found.difference(first))]


def grouped(
    runs: Sequence[RunInfo],
    metric: str,
    x: str = STEPS,
    statistic: Statistic = "mean",
    band: Band = "bootstrap",
) -> tuple[list[Curve], list[Group]]:
    """The curves of the runs, and their groups where they can be put together (else none)."""
    held = tuple((run.path, run.status.total, readers.recorded(run)) for run in runs)

    def make() -> tuple[list[Curve], list[Group]]:
        found = curves(runs, metric, x)
        return found, groups(found, statistic, band) if advancing(found) else []

    return _GROUPED.get((held, metric, x, statistic, band), make)


def curves(runs: Sequence[RunInfo], metric: str, x: str = STEPS) -> list[Curve]:
    """The metric of every run along the axis, with what sets runs of one learner apart."""
    apart = settings.variants(runs)
    return [curve(run, metric, x, apart[run.run_id]) for run in runs]


def curve(run: RunInfo, metric: str, x: str = STEPS, variant: str = "") -> Curve:
    """The metric of one run along the axis, in the order it was recorded."""
    frame = readers.metrics(run)
    if x in (STEPS, SHARE):
        step, value = curve_points(frame, metric)
        if x == SHARE:
            step = step / max(run.status.total, 1)
    else:
        step, value = points_against(frame, metric, "time/wall_s" if x == WALL else x)
        if x == WALL:
            step = step / 60
    return Curve(run.run_id, run.env, run.learner, run.preset, run.seed, step, value, variant)


def advancing(found: Sequence[Curve]) -> bool:
    """Along the axis every run only goes on, so that runs can be put together."""
    return all((np.diff(one.step) > 0).all() for one in found)
