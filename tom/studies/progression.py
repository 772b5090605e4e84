"""The weight progression study: do TOM's weights follow the policy instead of the position?

Every recording of SAC (random half, ordered half) is weighed three times: for its trained policy,
for the random policy (the profile must reverse), and for its trained policy with shuffled rows
(TOM's profile must stay the same; PMAC's must change, because it depends on the position).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Literal, get_args

import numpy as np

from tom.analysis.ordered_data import of_run
from tom.analysis.progression import DECILES, Progression, progression, same_profile
from tom.analysis.weighing import Weighed, weigh
from tom.config import RunConfig, SacRecordingConfig, TomConfig
from tom.envs import task
from tom.policy.stored import NAME, UniformPolicy, read_policy
from tom.record import RunReader, Store

Condition = Literal["own", "random", "shuffled"]
Preset = Literal["paper", "exact"]

SAC_SEEDS = {"halfcheetah": (0,), "hopper": (0, 1)}
"""number of recordings in the acceptance; other tasks have one"""


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


@dataclass(frozen=True)
class Finding:
    """One number of the acceptance for every seed; the median is tested."""

    recording: str
    preset: Preset
    condition: Condition
    learner: str
    quantity: str
    values: tuple[float, ...]
    bound: tuple[Literal["<=", ">=", "<"], float] | None

    @property
    def median(self) -> float:
        return median(self.values)

    @property
    def met(self) -> bool | None:
        """Whether the bound holds; None if there is no bound."""
        if self.bound is None:
            return None
        sign, limit = self.bound
        at_most = self.median < limit if sign == "<" else self.median <= limit
        return self.median >= limit if sign == ">=" else at_most


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
RISE = f"first decile above 1 ({NEVER}: none)"


def recording_config(env: str, seed: int, steps: int) -> SacRecordingConfig:
    """The settings of a recording of the study."""
    return SacRecordingConfig(env=task(env).name, seed=seed, steps=steps)


def recorded(store: Store, config: SacRecordingConfig) -> RunReader | None:
    """The newest finished recording with these settings, or None."""
    for run in store.runs():
        if run.learner == config.learner and run.status.state == "finished" and _like(run, config):
            return run
    return None


def _like(run: RunReader, config: SacRecordingConfig) -> bool:
    """Whether a run has the settings of `config`; of SAC's, those that both versions have."""
    theirs = run.config.get("config", {})
    ours = config.model_dump(mode="json")
    plain = ("env", "seed", "steps", "exploration_steps", "updates_per_step")
    if any(theirs.get(name) != ours[name] for name in plain):
        return False
    sac = theirs.get("sac", {})
    return all(sac[name] == ours["sac"][name] for name in sac if name in ours["sac"])


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
        stored = weigh(data.in_order(order), policy, known, config, both, case.seeds)
        weighed = (one.in_order(order) for one in stored)
    name, first = f"{run.env}-s{run.seed}", data.ordered_from
    return Result(name, run.env, first, case.condition, case.preset, tuple(weighed))


def checks(done: Sequence[Result]) -> list[Finding]:
    """Every number of the acceptance, for TOM and for PMAC."""
    findings: list[Finding] = []
    for case in done:
        if case.condition == "own":
            findings += _progress(case)
        elif case.condition == "random":
            findings += _turned(case)
        else:
            (own,) = (
                other
                for other in done
                if (other.recording, other.preset) == (case.recording, case.preset)
                and other.condition == "own"
            )
            findings += _moved(case, own)
    return findings


def _progress(case: Result) -> list[Finding]:
    random, last, spearman = BOUNDS.get(case.env, (None, None, None))
    tom, pmac = case.reports("tom"), case.reports("pmac")
    return [
        _check(case, "tom", "random half", [r.random_mean for r in tom], "<=", random),
        _check(case, "tom", "last two of 20 bins", [r.last_two for r in tom], ">=", last),
        _check(case, "tom", "Spearman, ordered half", [r.spearman for r in tom], ">=", spearman),
        _check(case, "tom", RISE, [r.first_rise or NEVER for r in tom]),
        _check(case, "tom", "ESS", [r.ess for r in tom]),
        _check(case, "pmac", "random half", [r.random_mean for r in pmac]),
        _check(case, "pmac", "last two of 20 bins", [r.last_two for r in pmac]),
        _check(case, "pmac", RISE, [r.first_rise or NEVER for r in pmac]),
        _check(case, "pmac", "ESS", [r.ess for r in pmac]),
    ]


def _turned(case: Result) -> list[Finding]:
    tom = case.reports("tom")
    return [
        _check(case, "tom", "random half", [r.random_mean for r in tom], ">=", TURNED[0]),
        _check(case, "tom", "last two of 20 bins", [r.last_two for r in tom], "<=", TURNED[1]),
    ]


def _moved(case: Result, own: Result) -> list[Finding]:
    kept = {
        learner: [
            same_profile(a.weights, b.weights)
            for a, b in zip(own.of(learner), case.of(learner), strict=True)
        ]
        for learner in ("tom", "pmac")
    }
    quantity = "Spearman with its profile in order"
    return [
        _check(case, "tom", quantity, kept["tom"], ">=", SAME),
        _check(case, "pmac", quantity, kept["pmac"], "<", SAME),
    ]


def _check(
    case: Result,
    learner: str,
    quantity: str,
    values: Sequence[float | None],
    sign: Literal["<=", ">=", "<"] = "<=",
    limit: float | None = None,
) -> Finding:
    numbers = tuple(float("nan") if v is None else float(v) for v in values)
    bound = None if limit is None else (sign, limit)
    return Finding(case.recording, case.preset, case.condition, learner, quantity, numbers, bound)
