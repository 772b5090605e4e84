"""Recordings of SAC that studies take or make, and statistics over recordings."""

from argparse import ArgumentParser, Namespace
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from math import isfinite, nan
from statistics import median
from typing import NamedTuple

from matplotlib.figure import Figure
from scipy.stats import binomtest

from tom.analysis.statistics import Interval, interval, mean
from tom.config import SacRecordingConfig
from tom.record import RunReader, Store
from tom.reports.figures import NEUTRAL, TEXT, new_figure
from tom.studies.study import Lab, Row, add_env, add_jobs, add_store, tasks, whole

Value = tuple[str, str, float]
"""task, recording, and a value at one of its moments"""

QUESTIONS: dict[tuple[str, str], str] = {
    ("tom-discounted", "uniform"): "Is TOM as printed better than no weights?",
    ("tom-mended", "uniform"): "Is the mended one?",
    ("half-tom-mended", "uniform"): "Is it, if half of its weight is uniform?",
    ("half-recency", "uniform"): "Is recency, if half of its weight is uniform?",
    ("tom-mended", "tom-discounted"): "Is the mended objective better than the printed one?",
    ("tom-mended", "ratio"): "Does Q bring something on top of the discriminator?",
    ("tom-mended", "recency"): "Is TOM better than recency, which trains no network?",
    ("half-tom-mended", "half-recency"): "Is it better than recency, if half of either is uniform?",
    ("policy-distance", "recency"): "Is the policy's distance at each row better than recency?",
    ("policy-distance", "tom-mended"): "Is it better than TOM mended, which trains two networks?",
    ("policy-distance", "uniform"): "Is it better than no weights?",
    ("pmer", "uniform"): "Are rows of large error better than no weights?",
    ("tom-stationary-validated", "tom-stationary"): "Is it better to stop Q on held-out episodes?",
    ("tom-stationary-validated", "tom-discounted-validated"): "Does the flow matter?",
}
"""what is asked of two ways: the first one, and the one that it has to beat

Those of policy distance and PMER were written down on 2026-11-27, before any result was read: on
the same moments, is policy distance nearer to the policy (`footprint`) than recency and `mended`,
and is the error of its model there lower than that of uniform weights at 200 x 4 (`capacity`)? Does
PMER lower that error?
"""


class Signs(NamedTuple):
    """On how many of `n` recordings a difference is above zero, and the sign test's p."""

    above: int
    n: int
    p: float


def sign_test(differences: Iterable[Value]) -> Signs:
    """Exact two-sided sign test over recordings; one counts by most of its moments.

    Recordings with as many moments above as below zero do not count. Unlike a bootstrap interval it
    is right for few recordings.
    """
    balance: dict[tuple[str, str], int] = {}
    for env, recording, value in differences:
        sign = (value > 0) - (value < 0)
        balance[env, recording] = balance.get((env, recording), 0) + sign
    above, n = sum(v > 0 for v in balance.values()), sum(v != 0 for v in balance.values())
    return Signs(above, n, float(binomtest(above, n).pvalue) if n else 1.0)


def over_recordings(values: Iterable[Value]) -> Interval:
    """Mean over tasks of the mean over recordings of the median over moments.

    The bootstrap interval resamples recordings within each task; its bounds are NaN if a task has
    only one. Raises ValueError if there is no value.
    """
    moments: dict[str, dict[str, list[float]]] = {}
    for env, recording, value in values:
        moments.setdefault(env, {}).setdefault(recording, []).append(value)
    return interval([[median(of) for of in each.values()] for each in moments.values()], mean)


def comparisons(
    outcomes: Sequence[Row],
    value: Callable[[Row], float],
    measure: str,
    better_at: str,
    **more: str,
) -> Iterator[Row]:
    """A row for each of `QUESTIONS`, over the moments that both ways were examined at.

    `value` is what is compared, lower is better; moments where it is NaN do not count. The
    difference at a moment is the median over seeds. `measure` and `better_at` are the titles of the
    difference, which is a mean over tasks, and of the moments where the first way is better; the
    difference in each task is under its name, NaN without a moment there.
    """
    at = {(one["way"], *trial_of(one)): value(one) for one in outcomes}
    envs = dict.fromkeys(one["env"] for one in outcomes)
    for way, against in QUESTIONS:
        trials: dict[tuple[str, str, int], list[float]] = {}
        for one in outcomes:
            gap = value(one) - at.get((against, *trial_of(one)), nan)
            if one["way"] == way and isfinite(gap):
                trials.setdefault((one["env"], one["recording"], one["step"]), []).append(gap)
        gaps: list[Value] = [(env, run, median(each)) for (env, run, _), each in trials.items()]
        if not gaps:
            continue
        whole, signs = over_recordings(gaps), sign_test(gaps)
        in_task = {env: [gap for gap in gaps if gap[0] == env] for env in envs}
        yield {
            "way": way,
            "against": against,
            **more,
            measure: whole.value,
            "low": whole.low,
            "high": whole.high,
            better_at: sum(gap < 0 for _, _, gap in gaps),
            "n": len(gaps),
            "better on": signs.n - signs.above,
            "recordings": signs.n,
            "p": signs.p,
            **{env: over_recordings(of).value if of else nan for env, of in in_task.items()},
        }


def spanned(row: Row, name: str) -> str:
    """The number of a row with its interval, in words."""
    bounds = f" [{row['low']:.2f}, {row['high']:.2f}]" if isfinite(row["low"]) else ""
    return f"{row[name]:.2f}{bounds}"


def trial_of(one: Row) -> tuple[str, int, int]:
    """What two ways of weighing share: recording, step and seed."""
    return one["recording"], one["step"], one["seed"]


def strips(
    envs: Sequence[str],
    rows: Mapping[str, str],
    values: Mapping[tuple[str, str], Sequence[float]],
    even: float,
) -> Figure:
    """One panel per task: the values of each row as points, their median as a stroke.

    `rows` are the names from the top down, with their colours; `values` are by task and row. A
    dashed line is where a way is as good as uniform weights.
    """
    figure = new_figure(2.2 + 2.6 * len(envs), 0.7 + 0.24 * max(len(rows), 2))
    axes = figure.subplots(1, len(envs), squeeze=False, sharey=True)[0]
    upwards = list(rows)[::-1]
    for ax, env in zip(axes, envs, strict=True):
        ax.axvline(even, color=NEUTRAL, linewidth=0.8, linestyle="--")
        ax.set_title(env)
        for height, name in enumerate(upwards):
            of = values.get((env, name), ())
            colour = rows[name]
            ax.scatter(of, [height] * len(of), s=14, color=colour, alpha=0.55, linewidths=0)
            if of:
                ax.plot([median(of)] * 2, [height - 0.35, height + 0.35], color=TEXT, linewidth=1.6)
    axes[0].set_yticks(range(len(rows)), upwards)
    return figure


SAC_SEEDS = {"halfcheetah": (0,), "hopper": (0, 1)}
"""the recordings of the acceptance; other tasks have one"""


def add_recordings(parser: ArgumentParser) -> None:
    """Add the options that choose recordings of SAC and the learners' seeds."""
    add_env(parser, list(SAC_SEEDS))
    parser.add_argument("--steps", type=whole(1000), default=50_000, help="steps of SAC [50000]")
    parser.add_argument("--seeds", nargs="+", type="seed", default=[0, 1, 2], help="TOM's [0 1 2]")
    add_store(parser)
    add_jobs(parser)


def recordings(args: Namespace, lab: Lab, seeds: list[int] | None = None) -> list[RunReader]:
    """The recordings of every task and of SAC's `seeds`; missing ones are made."""
    store = Store(args.store)
    configs = [
        SacRecordingConfig(env=env, seed=seed, steps=args.steps)
        for env in tasks(args.env)
        for seed in seeds or SAC_SEEDS.get(env, (0,))
    ]
    return [recorded(store, config) or lab.record(store, config) for config in configs]


def recorded(store: Store, config: SacRecordingConfig) -> RunReader | None:
    """The newest finished recording with these settings, or None.

    Of SAC's settings those count that both versions have.
    """
    ours = config.model_dump(mode="json")
    for run in store.runs():
        if run.learner == config.learner and run.status.state == "finished":
            theirs = run.config.get("config", {})
            both = ours["sac"].keys() & theirs.get("sac", {}).keys()
            plain = ("env", "seed", "steps", "exploration_steps", "updates_per_step")
            if all(theirs.get(name) == ours[name] for name in plain) and all(
                theirs["sac"][name] == ours["sac"][name] for name in both
            ):
                return run
    return None
