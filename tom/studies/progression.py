"""Do TOM's weights follow the policy instead of the position in the buffer?

Every recording of SAC (random half, ordered half) is weighed three times: for its trained policy,
for the random policy (the profile must reverse), and for its trained policy with shuffled rows
(TOM's profile must stay the same; PMAC's must change, because it depends on the position). The
first preset is judged, by its median over TOM's seeds.
"""

from argparse import ArgumentParser, Namespace
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from math import nan
from pathlib import Path
from statistics import median
from typing import Literal, get_args

import numpy as np
import torch
from matplotlib.figure import Figure
from numpy.typing import NDArray

from tom.analysis.ordered_data import load_run
from tom.analysis.progression import DECILES, LATE, progression, same_profile
from tom.analysis.weighing import Weighed, weigh
from tom.config import RunConfig, SacRecordingConfig, TomConfig
from tom.envs import task
from tom.errors import UserError, check_known
from tom.policy.stored import NAME, UniformPolicy, read_policy
from tom.readable import in_words, whole
from tom.record import RunReader, Store
from tom.reports.figures import Panel, profile_figure
from tom.reports.report import in_short
from tom.reports.weighing_files import profile_rows, profiles, write_weights
from tom.studies.study import (
    Findings,
    Row,
    add_jobs,
    add_runs,
    check,
    compute,
    tasks,
)
from tom.studies.verdicts import by_acceptance

TITLE = "Weight progression"
QUESTION = "Do the weights follow the policy along an ordered buffer?"
CLAIM = (
    "On a buffer whose first half is random and whose second half is SAC's training in order, "
    "TOM's weights for the trained policy are low on the random half and rise towards the end; "
    "they start to rise earlier than recency would have it, sometimes non-monotonically (5.2)."
)
Condition = Literal["own", "random", "shuffled"]
Preset = Literal["paper", "exact"]

PRESETS: tuple[Preset, ...] = ("exact", "paper")
SAME = 0.9
"""rank correlation over 20 bins from which two profiles count as the same"""
NEVER = DECILES + 1
LOW, LAST, RANK = "random half", "last two of 20 bins", "Spearman, ordered half"
RISE = f"first decile above 1 ({NEVER}: none)"
BOUNDS: dict[str, dict[str, tuple[str, float]]] = {
    "halfcheetah": {LOW: ("<=", 0.30), LAST: (">=", 4.0), RANK: (">=", 0.9)},
    "hopper": {LOW: ("<=", 0.60), LAST: (">=", 2.5), RANK: (">=", 0.5)},
}
TURNED = {LOW: (">=", 1.25), LAST: ("<=", 0.3)}
"""bounds for the random policy"""
NUMBERS = {LOW: "random_mean", LAST: "last_two", RANK: "spearman", RISE: "first_rise", "ESS": "ess"}
"""the numbers of an acceptance, and their names in a `progression`"""
CLAIMS: dict[str, tuple[str, Callable[[float], bool]]] = {
    LOW: ("lie below the mean over the random half", lambda value: value < 1),
    RANK: ("grow along SAC's half (rank correlation)", lambda value: value > 0),
    RISE: (
        "are above the mean before its last fifth (first such tenth)",
        lambda value: value <= DECILES - LATE,
    ),
}
"""what the paper says of TOM's weights, by the number that shows it"""
BINS = 100
TITLES = {
    ("own", "tom"): "TOM, its trained policy",
    ("random", "tom"): "TOM, the random policy",
    ("shuffled", "tom"): "TOM, rows shuffled",
    ("own", "pmac"): "PMAC",
    ("shuffled", "pmac"): "PMAC, rows shuffled",
}

SAC_SEEDS = {"halfcheetah": (0,), "hopper": (0, 1)}
"""the recordings of the acceptance; other tasks have one"""

verdict = by_acceptance


def add_options(parser: ArgumentParser) -> None:
    add_runs(parser, SAC_SEEDS)
    parser.add_argument("--steps", type=whole(1000), default=50_000, help="steps of SAC [50000]")
    parser.add_argument("--seeds", nargs="+", type="seed", default=[0, 1, 2], help="TOM's [0 1 2]")
    add_jobs(parser)
    parser.add_argument(
        "--sac-seeds", nargs="+", type="seed", help="seeds of recordings [as accepted]"
    )
    parser.add_argument(
        "--preset", nargs="+", default=list(PRESETS), help="TOM's presets [exact paper]"
    )


def find(args: Namespace) -> Findings:
    check_known("preset", args.preset, PRESETS)
    runs = recordings(args)
    asked = [
        Case(run.path, condition, preset, tuple(args.seeds), run.created)
        for run in runs
        for preset in args.preset
        for condition in get_args(Condition)
    ]
    done = compute(
        args, result, asked, lambda one: f"{one.recording}: TOM {one.preset}, {one.condition}"
    )
    for case in done:
        name = f"{case.recording}-{case.condition}-{case.preset}.parquet"
        write_weights(args.out / name, case.weighed)
    judged, found = args.preset[0], checks(done)
    caption = "Mean weight along the ordered buffer, single seeds faint"
    return Findings(
        sentences=in_sentences([row for row in found if row["preset"] == judged]),
        files={"profiles": _profiles(done)},
        titles={},
        figures={
            "progression": (caption, figure([case for case in done if case.preset == judged]))
        },
        checks=[row if row["preset"] == judged else {**row, "met": None} for row in found],
        origin={
            "n": f"{len(runs)} recordings, {len(args.seeds)} seeds of TOM on each",
            "seeds": in_short(args.seeds),
        },
    )


def recordings(args: Namespace) -> list[RunReader]:
    """The recordings that are asked for. Raises UserError if one is missing."""
    store, found, lacking = Store(args.store), list[RunReader](), []
    for env in tasks(args.env):
        for seed in args.sac_seeds or SAC_SEEDS.get(env, (0,)):
            run = find_recording(store, SacRecordingConfig(env=env, seed=seed, steps=args.steps))
            if run is None:
                lacking.append(f"tom record-sac --env {env} --steps {args.steps} --seed {seed}")
            else:
                found.append(run)
    if lacking:
        raise UserError(f"{store.path}/ lacks recordings: {'; '.join(lacking)}")
    return found


def find_recording(store: Store, config: SacRecordingConfig) -> RunReader | None:
    """The newest finished recording with these settings, as far as it has them, or None."""
    counted = {"env", "seed", "steps", "exploration_steps", "updates_per_step", "sac"}
    ours = in_words(config.model_dump(mode="json", include=counted)).items()
    finished = (
        run
        for run in store.runs()
        if run.learner == config.learner and run.status.state == "finished"
    )
    same = (run for run in finished if all(run.settings.get(path, w) == w for path, w in ours))
    return next(same, None)


@dataclass(frozen=True)
class Case:
    """One recording, weighed under one condition by TOM with a preset and by PMAC."""

    recording: Path
    condition: Condition
    preset: Preset
    seeds: tuple[int, ...]
    made: str  # time of creation: a new recording under the same path is another case


@dataclass(frozen=True)
class Result:
    """All seeds and learners of one case, weights in the order of collection."""

    recording: str
    env: str
    ordered_from: int
    condition: Condition
    preset: Preset
    weighed: tuple[Weighed, ...]

    def of(self, learner: str) -> list[Weighed]:
        """One learner's results, by seed."""
        return [one for one in self.weighed if one.learner == learner]


def result(case: Case) -> Result:
    """Weigh the recording of `case`; not by PMAC for the random policy, as it uses no policy."""
    run = RunReader(case.recording)
    known, data = task(run.env), load_run(run)
    policy, learners = read_policy(run.path / NAME), ("tom", "pmac")
    config = RunConfig(env=run.env, learner="tom", tom=TomConfig.preset(case.preset))
    order = np.arange(len(data))
    if case.condition == "random":
        policy, learners = UniformPolicy(known.obs_dim, known.action_dim), ("tom",)
    elif case.condition == "shuffled":
        order = np.random.default_rng(0).permutation(len(data))
    rows = replace(data, transitions=data.transitions[torch.from_numpy(order)])
    found = weigh(rows, policy, known, config, learners, case.seeds)
    weighed = tuple(undo_shuffle(one, order) for one in found)
    name = f"{run.env}-s{run.seed}"
    return Result(name, run.env, data.ordered_from, case.condition, case.preset, weighed)


def undo_shuffle(weighed: Weighed, order: NDArray[np.int64]) -> Weighed:
    """The weights of shuffled rows in the order of collection: row i belongs to row order[i]."""
    back = np.argsort(order)
    ratio = None if weighed.log_ratio is None else weighed.log_ratio[back]
    terms = {name: term[back] for name, term in weighed.terms.items()}
    return replace(weighed, weights=weighed.weights[back], log_ratio=ratio, terms=terms)


def checks(done: Sequence[Result]) -> list[Row]:
    """Every number of the acceptance, for TOM and for PMAC."""
    rows = []
    for case in done:
        if case.condition == "shuffled":
            like = (case.recording, case.preset, "own")
            (own,) = (o for o in done if (o.recording, o.preset, o.condition) == like)
            for learner, sign in (("tom", ">="), ("pmac", "<")):
                pairs = zip(own.of(learner), case.of(learner), strict=True)
                kept = [same_profile(a.weights, b.weights) for a, b in pairs]
                name = "Spearman with its profile in order"
                rows.append(finding(case, learner, name, kept, (sign, SAME)))
            continue
        bounds = BOUNDS.get(case.env, {}) if case.condition == "own" else TURNED
        for learner in dict.fromkeys(one.learner for one in case.weighed):
            shapes = [progression(one.weights, case.ordered_from) for one in case.of(learner)]
            for name, key in NUMBERS.items():
                never = NEVER if name == RISE else nan
                values = [never if one[key] is None else float(one[key]) for one in shapes]
                bound = bounds.get(name) if learner == "tom" else None
                rows.append(finding(case, learner, name, values, bound))
    return rows


def finding(
    case: Result,
    learner: str,
    quantity: str,
    values: Sequence[float],
    bound: tuple[str, float] | None = None,
) -> Row:
    """One number of the acceptance for every seed; the median is judged, if there is a bound."""
    name = f"{case.recording}, {case.condition} policy, {learner}, {quantity}"
    judged = {"bound": "", "met": None} if bound is None else check(name, median(values), *bound)
    return {
        "name": name,
        "preset": case.preset,
        "condition": case.condition,
        "learner": learner,
        "quantity": quantity,
        "median": median(values),
        "by seed": " ".join(f"{value:.3g}" for value in values),
        "bound": judged["bound"],
        "met": judged["met"],
    }


def in_sentences(found: Sequence[Row]) -> list[str]:
    """On how many recordings TOM's weights are low on random data, rise, and rise early."""
    sentences = []
    for quantity, (what, holds) in CLAIMS.items():
        wanted = ("own", "tom", quantity)
        values = [
            row["median"]
            for row in found
            if (row["condition"], row["learner"], row["quantity"]) == wanted
        ]
        sentences.append(
            f"TOM's weights {what} in {sum(map(holds, values))} of {len(values)} recordings "
            f"({', '.join(f'{value:.3g}' for value in values)})."
        )
    return sentences


def _profiles(done: Sequence[Result]) -> Iterator[Row]:
    for case in done:
        of = {"recording": case.recording, "preset": case.preset, "policy": case.condition}
        for row in profile_rows(case.weighed, BINS):
            yield of | row


def figure(done: Sequence[Result]) -> Figure:
    """The profiles of one preset: a row for each recording, a panel for each of TITLES."""
    rows: dict[str, list[Panel]] = {}
    for (condition, learner), title in TITLES.items():
        for case in (case for case in done if case.condition == condition):
            share = case.ordered_from / len(case.weighed[0].weights)
            panel = Panel(title, learner, profiles(case.weighed, learner, BINS), share)
            rows.setdefault(case.recording, []).append(panel)
    return profile_figure(rows)
