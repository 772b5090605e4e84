"""Do TOM's weights follow the policy instead of the position in the buffer?

Every recording of SAC (random half, ordered half; made where the store has none) is weighed three
times: for its trained policy, for the random policy (the profile must reverse), and for its trained
policy with shuffled rows (TOM's profile must stay the same; PMAC's must change, because it depends
on the position). The median over TOM's seeds is judged, of the first preset.
"""

from argparse import ArgumentParser, Namespace
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from math import nan
from pathlib import Path
from statistics import median
from typing import Literal, get_args

import numpy as np
import torch
from matplotlib.figure import Figure
from numpy.typing import NDArray

from tom.analysis.ordered_data import of_run
from tom.analysis.progression import DECILES, LATE, Progression, progression, same_profile
from tom.analysis.weighing import Weighed, weigh
from tom.config import RunConfig, TomConfig
from tom.envs import task
from tom.policy.stored import NAME, UniformPolicy, read_policy
from tom.record import RunReader
from tom.reports.figures import Panel, profile_figure
from tom.reports.report import seeds as in_short
from tom.reports.weighing_files import profile_rows, profiles, write_weights
from tom.studies.recordings import add_recordings, recordings
from tom.studies.study import Findings, Lab, Row, Study, as_the_paper_says, check_known

Condition = Literal["own", "random", "shuffled"]
Preset = Literal["paper", "exact"]

PRESETS: tuple[Preset, ...] = ("exact", "paper")
BOUNDS: dict[str, tuple[float, float, float]] = {
    "halfcheetah": (0.30, 4.0, 0.9),
    "hopper": (0.60, 2.5, 0.5),
}
"""bounds: random half at most, last two of 20 bins and Spearman over the ordered half at least"""
TURNED = (1.25, 0.3)
"""bounds for the random policy: random half at least, last two of 20 bins at most"""
SAME = 0.9
"""rank correlation over 20 bins from which two profiles count as the same"""
NEVER = DECILES + 1
LOW, LAST, RANK = "random half", "last two of 20 bins", "Spearman, ordered half"
RISE = f"first decile above 1 ({NEVER}: none)"
BINS = 100
TITLES = {
    ("own", "tom"): "TOM, its trained policy",
    ("random", "tom"): "TOM, the random policy",
    ("shuffled", "tom"): "TOM, rows shuffled",
    ("own", "pmac"): "PMAC",
    ("shuffled", "pmac"): "PMAC, rows shuffled",
}


def add_options(parser: ArgumentParser) -> None:
    add_recordings(parser)
    parser.add_argument("--sac-seeds", nargs="+", type="seed", help="of recordings [as accepted]")
    parser.add_argument("--preset", nargs="+", default=list(PRESETS), help="TOM's [exact paper]")


def find(args: Namespace, lab: Lab) -> Findings:
    check_known("preset", args.preset, PRESETS)
    runs = recordings(args, lab, args.sac_seeds)
    done = lab.compute(
        result,
        cases(runs, args.preset, args.seeds),
        lambda one: f"{one.recording}: TOM {one.preset}, {one.condition}",
    )
    for case in done:
        name = f"{case.recording}-{case.condition}-{case.preset}.parquet"
        write_weights(args.out / name, case.weighed)
    found, judged = checks(done), args.preset[0]
    rows = [
        {
            "name": "{recording}, {condition} policy, {learner}, {quantity}".format(**c),
            "preset": c["preset"],
            "median": c["median"],
            "by seed": " ".join(f"{value:.3g}" for value in c["values"]),
            "bound": "{} {:g}".format(*c["bound"]) if c["bound"] else "",
            "met": c["met"] if c["preset"] == judged else None,
        }
        for c in found
    ]
    caption = "Mean weight along the ordered buffer, single seeds faint"
    drawn = [case for case in done if case.preset == judged]
    return Findings(
        said=verdict([row for row in found if row["preset"] == judged]),
        files={"profiles": _profiles(done)},
        figures={"progression": (caption, partial(figure, drawn))},
        tables=[],
        checks=rows,
        origin={
            "n": f"{len(runs)} recordings, {len(args.seeds)} seeds of TOM on each",
            "seeds": in_short(args.seeds),
        },
        json={"checks": found},
    )


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

    def reports(self, learner: str) -> list[Progression]:
        """One learner's summaries, by seed."""
        return [progression(one.weights, self.ordered_from) for one in self.of(learner)]


def cases(runs: Sequence[RunReader], presets: Sequence[Preset], seeds: Sequence[int]) -> list[Case]:
    """The three conditions of every recording, under every preset of TOM."""
    return [
        Case(run.path, condition, preset, tuple(seeds), run.created)
        for run in runs
        for preset in presets
        for condition in get_args(Condition)
    ]


def result(case: Case) -> Result:
    """Weigh the recording of `case`; not by PMAC for the random policy, as it uses no policy."""
    run = RunReader(case.recording)
    known, data = task(run.env), of_run(run)
    policy = read_policy(run.path / NAME)
    config = RunConfig(env=run.env, learner="tom", tom=TomConfig.preset(case.preset))
    both = ("tom", "pmac")
    if case.condition == "own":
        weighed = weigh(data, policy, known, config, both, case.seeds)
    elif case.condition == "random":
        policy = UniformPolicy(known.obs_dim, known.action_dim)
        weighed = weigh(data, policy, known, config, ("tom",), case.seeds)
    else:
        order = np.random.default_rng(0).permutation(len(data))
        shuffled = replace(data, transitions=data.transitions[torch.from_numpy(order)])
        weighed = (
            in_order(one, order) for one in weigh(shuffled, policy, known, config, both, case.seeds)
        )
    name, first = f"{run.env}-s{run.seed}", data.ordered_from
    return Result(name, run.env, first, case.condition, case.preset, tuple(weighed))


def in_order(one: Weighed, order: NDArray[np.int64]) -> Weighed:
    """The weights of shuffled rows in the order of collection: row i belongs to row order[i]."""
    back = np.argsort(order)
    ratio = None if one.log_ratio is None else one.log_ratio[back]
    terms = {name: term[back] for name, term in one.terms.items()}
    return replace(one, weights=one.weights[back], log_ratio=ratio, terms=terms)


def checks(done: Sequence[Result]) -> list[Row]:
    """Every number of the acceptance, for TOM and for PMAC."""
    found: list[Row] = []
    for case in done:
        tom, pmac = case.reports("tom"), case.reports("pmac")
        if case.condition == "own":
            low, last, rank = BOUNDS.get(case.env, (None, None, None))
            found += [
                finding(case, "tom", LOW, [r.random_mean for r in tom], "<=", low),
                finding(case, "tom", LAST, [r.last_two for r in tom], ">=", last),
                finding(case, "tom", RANK, [r.spearman for r in tom], ">=", rank),
                finding(case, "tom", RISE, [r.first_rise or NEVER for r in tom]),
                finding(case, "tom", "ESS", [r.ess for r in tom]),
                finding(case, "pmac", LOW, [r.random_mean for r in pmac]),
                finding(case, "pmac", LAST, [r.last_two for r in pmac]),
                finding(case, "pmac", RISE, [r.first_rise or NEVER for r in pmac]),
                finding(case, "pmac", "ESS", [r.ess for r in pmac]),
            ]
        elif case.condition == "random":
            found += [
                finding(case, "tom", LOW, [r.random_mean for r in tom], ">=", TURNED[0]),
                finding(case, "tom", LAST, [r.last_two for r in tom], "<=", TURNED[1]),
            ]
        else:
            like = (case.recording, case.preset, "own")
            (own,) = (o for o in done if (o.recording, o.preset, o.condition) == like)
            for learner, sign in (("tom", ">="), ("pmac", "<")):
                pairs = zip(own.of(learner), case.of(learner), strict=True)
                kept = [same_profile(a.weights, b.weights) for a, b in pairs]
                quantity = "Spearman with its profile in order"
                found.append(finding(case, learner, quantity, kept, sign, SAME))
    return found


def finding(
    case: Result,
    learner: str,
    quantity: str,
    values: Sequence[float | None],
    sign: str = "",
    limit: float | None = None,
) -> Row:
    """One number of the acceptance for every seed; the median is judged, if there is a bound."""
    numbers = [nan if value is None else float(value) for value in values]
    middle, met = median(numbers), None
    if limit is not None:
        met = {"<=": middle <= limit, ">=": middle >= limit, "<": middle < limit}[sign]
    return {
        "recording": case.recording,
        "preset": case.preset,
        "condition": case.condition,
        "learner": learner,
        "quantity": quantity,
        "values": numbers,
        "bound": None if limit is None else (sign, limit),
        "median": middle,
        "met": met,
    }


def verdict(found: Sequence[Row]) -> list[str]:
    """Whether TOM's weights are low on random data, rise, and rise before the end."""
    said = []
    for quantity, what, holds in (
        (LOW, "lie below the mean over the random half", lambda value: value < 1),
        (RANK, "grow along SAC's half (rank correlation)", lambda value: value > 0),
        (
            RISE,
            "are above the mean before its last fifth (first such tenth)",
            lambda value: value <= DECILES - LATE,
        ),
    ):
        wanted = ("own", "tom", quantity)
        own = [c for c in found if (c["condition"], c["learner"], c["quantity"]) == wanted]
        values = [c["median"] for c in own]
        if values:
            held = sum(map(holds, values))
            said.append(
                f"TOM's weights {what} in {held} of {len(values)} recordings "
                f"({', '.join(f'{value:.3g}' for value in values)}): "
                f"{as_the_paper_says(held, len(values))}"
            )
    return said


def _profiles(done: Sequence[Result]) -> Iterator[Row]:
    for case in done:
        of = {"recording": case.recording, "preset": case.preset, "policy": case.condition}
        for row in profile_rows(case.weighed, BINS):
            yield of | row


def figure(done: Sequence[Result]) -> Figure:
    """The profiles of one preset: a row for each recording, a panel for each of TITLES."""
    panels = {
        recording: [
            Panel(title, learner, profiles(case.weighed, learner, BINS))
            for (condition, learner), title in TITLES.items()
            for case in done
            if (case.recording, case.condition) == (recording, condition)
        ]
        for recording in dict.fromkeys(case.recording for case in done)
    }
    shares = {case.recording: case.ordered_from / len(case.weighed[0].weights) for case in done}
    return profile_figure(panels, shares)


STUDY = Study(
    "progression",
    "Weight progression",
    __doc__,
    "On a buffer whose first half is random and whose second half is SAC's training in order, "
    "TOM's weights for the trained policy are low on the random half and rise towards the end; "
    "they start to rise earlier than recency would have it, sometimes non-monotonically (5.2).",
    add_options,
    find,
)
