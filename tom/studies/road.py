"""Does TOM drive where MLE does not? Road-and-rocks over seeds, with controls and a sweep.

A study is a list of cases, each with an outcome. `acceptance` and `controls` test outcomes, so a
caller may compute them in one process or in many.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import takewhile
from math import nan

import numpy as np
from numpy.typing import NDArray

from tom import offline
from tom.config import RoadConfig
from tom.events import Collected, Evaluation, Event, Metrics, Weights
from tom.learners import follows_value
from tom.road.measure import returns
from tom.studies.checks import Check, at_least, at_most

TURNS = (0.0, 60.0, 90.0, 105.0, 120.0, 135.0, 150.0, 180.0)
"""mean turns of the sweep, degrees; the spread is half the turn"""
RATIO_MEDIAN, RATIO_MIN, SHARE_MIN = 10.0, 5.0, 0.85
EXPERT_ERROR_MAX, ROAD_ERROR_MAX = 0.35, 0.6
TOM_RETURN_MIN, TOM_SUCCESS_MIN, SEEDS_THAT_DRIVE = 0.8, 0.9, 0.75
MLE_RETURN_MAX, MLE_SUCCESS_MAX = 0.25, 0.2
SWAPPED_RATIO_MAX, MEAN_ZERO_RETURN_MIN = 3.0, -30.0


@dataclass(frozen=True)
class Case:
    """A configuration and its name in the tables."""

    name: str
    config: RoadConfig
    optimise: bool = True
    """if false, SAC is left out: only the weights, the model and its planner"""


@dataclass(frozen=True)
class Outcome:
    """The outcome of one case; errors in full steps, success as a share of episodes.

    Values that were not measured are NaN: SAC if it was left out, and the planner of a learner that
    follows the value function, because it drives only once, before there is a value function.
    """

    name: str
    seed: int
    turn: float
    road_ratio: float
    road_share: float
    error_expert: float
    error_road: float
    error_rocks: float
    return_random: float
    return_expert: float
    planner_return: float
    planner_success: float
    sac_return: float = nan
    sac_success: float = nan

    def normalised(self, value: float) -> float:
        """(R - R_random) / (R_expert - R_random)."""
        return (value - self.return_random) / (self.return_expert - self.return_random)


@dataclass(frozen=True)
class Story:
    """An outcome with the curve of returns and the weights."""

    outcome: Outcome
    returns: list[tuple[int, float]]  # (step of policy optimisation, mean return)
    places: NDArray[np.float32] | None = None  # (N, 2) of the transitions
    weights: NDArray[np.float32] | None = None  # (N,)


def outcome(case: Case) -> Outcome:
    """Run a case; returns its outcome."""
    return tell(case).outcome


def tell(case: Case) -> Story:
    """Run a case; returns its outcome with the curve and the weights, for the map."""
    events: Iterator[Event] = offline.Offline(case.config).events()
    if not case.optimise:
        events = takewhile(lambda event: event.env_step == 0, events)
    values: dict[str, float] = {}
    curve: list[tuple[int, float]] = []
    last: Evaluation | None = None
    places, weights = None, None
    for event in events:
        match event:
            case Metrics():
                values |= event.values
            case Evaluation():
                last = event
                curve.append((event.env_step, returns(event.episodes)[0]))
            case Collected():
                places = np.asarray(event.transitions.obs, np.float32)
            case Weights():
                weights = event.weight
    result = Outcome(
        name=case.name,
        seed=case.config.seed,
        turn=case.config.turn,
        **{name: values[path] for name, path in _PATHS.items()},
    )
    if follows_value(case.config.learner):
        result = replace(result, planner_return=nan, planner_success=nan)
    if case.optimise and last is not None:
        sac_return, sac_success = returns(last.episodes)
        result = replace(result, sac_return=sac_return, sac_success=sac_success)
    return Story(result, curve, places, weights)


_PATHS = {
    "road_ratio": "weights/road_ratio",
    "road_share": "weights/road_share",
    "error_expert": "model/error_expert",
    "error_road": "model/error_road",
    "error_rocks": "model/error_rocks",
    "return_random": "eval/return_random",
    "return_expert": "eval/return_expert",
    "planner_return": "planner/return",
    "planner_success": "planner/success",
}


# The cases


def acceptance_cases(seeds: Sequence[int]) -> list[Case]:
    """MLE and TOM."""
    return [_case(name, name, seed) for seed in seeds for name in ("mle", "tom")]


def control_cases(seeds: Sequence[int]) -> list[Case]:
    """Controls that must fail, or reverse, if the claim is to be meaningful."""
    return [
        case
        for seed in seeds
        for case in (
            replace(_case("labels swapped", "labels-swapped", seed), optimise=False),
            _case("mle, mean-zero rocks", "mle", seed, turn=0.0, spread=180.0),
            _case("pmac, expert last", "pmac", seed),
            _case("pmac, expert first", "pmac", seed, expert_first=True),
        )
    ]


def baseline_cases(seeds: Sequence[int]) -> list[Case]:
    """VaGram, simpler weightings, and TOM with uniform start states of rollouts."""
    uniform_starts = {"rollout": {"weighted_starts": False}}
    return [
        case
        for seed in seeds
        for case in (
            *(
                _case(name, name, seed)
                for name in ("vagram", "expert-only", "footprint-only", "ratio")
            ),
            _case("tom, uniform starts", "tom", seed, **uniform_starts),
        )
    ]


def sweep_cases(seeds: Sequence[int]) -> list[Case]:
    """MLE and TOM for growing mean turns of the rocks (only the planner, which tests the model)."""
    return [
        replace(_case(name, name, seed, turn=turn, spread=turn / 2), optimise=False)
        for turn in TURNS
        for seed in seeds
        for name in ("mle", "tom")
    ]


def _case(name: str, learner: str, seed: int, **changes: object) -> Case:
    return Case(name, RoadConfig(learner=learner, seed=seed).but(**changes))


# The verdicts


def acceptance(outcomes: Sequence[Outcome]) -> list[Check]:
    """The checks of the claim, from MLE's and TOM's outcomes with the same seeds."""
    tom, mle = _named(outcomes, "tom"), _named(outcomes, "mle")
    ratio = [o.road_ratio for o in tom]
    pairs = list(zip(tom, mle, strict=True))
    return [
        at_least("weight ratio road / rocks, median", float(np.median(ratio)), RATIO_MEDIAN),
        at_least("weight ratio road / rocks, minimum", min(ratio), RATIO_MIN),
        at_least("share of weight on the road", min(o.road_share for o in tom), SHARE_MIN),
        at_most(
            "error on expert data over MLE's",
            max(t.error_expert / m.error_expert for t, m in pairs),
            EXPERT_ERROR_MAX,
        ),
        at_most(
            "error on the road over MLE's",
            max(t.error_road / m.error_road for t, m in pairs),
            ROAD_ERROR_MAX,
        ),
        at_least(
            "error on rocks over MLE's", min(t.error_rocks / m.error_rocks for t, m in pairs), 1.0
        ),
        *(check for kind in ("sac", "planner") for check in _driving(tom, mle, kind)),
    ]


def _driving(tom: Sequence[Outcome], mle: Sequence[Outcome], kind: str) -> list[Check]:
    def result(o: Outcome) -> tuple[float, float]:
        return o.normalised(getattr(o, f"{kind}_return")), getattr(o, f"{kind}_success")

    drives = [r >= TOM_RETURN_MIN and s >= TOM_SUCCESS_MIN for r, s in map(result, tom)]
    stuck = [r <= MLE_RETURN_MAX and s <= MLE_SUCCESS_MAX for r, s in map(result, mle)]
    return [
        at_least(
            f"share of seeds where TOM drives ({kind})", float(np.mean(drives)), SEEDS_THAT_DRIVE
        ),
        at_least(f"share of seeds where MLE does not ({kind})", float(np.mean(stuck)), 1.0),
    ]


def controls(outcomes: Sequence[Outcome]) -> list[Check]:
    """The checks of the controls."""
    ratio = [o.road_ratio for o in _named(outcomes, "labels swapped")]
    mean_zero = _named(outcomes, "mle, mean-zero rocks")
    last, first = _named(outcomes, "pmac, expert last"), _named(outcomes, "pmac, expert first")
    return [
        at_most("labels swapped: weight ratio, median", float(np.median(ratio)), SWAPPED_RATIO_MAX),
        at_most("labels swapped: weight ratio, maximum", max(ratio), SWAPPED_RATIO_MAX),
        at_least(
            "mean-zero rocks: MLE's return (planner)",
            _median(mean_zero, "planner_return"),
            MEAN_ZERO_RETURN_MIN,
        ),
        at_least(
            "mean-zero rocks: MLE's return (sac)",
            _median(mean_zero, "sac_return"),
            MEAN_ZERO_RETURN_MIN,
        ),
        at_least(
            "PMAC, expert data stored last: success (planner)",
            _median(last, "planner_success"),
            TOM_SUCCESS_MIN,
        ),
        at_most(
            "PMAC, expert data stored first: success (planner)",
            _median(first, "planner_success"),
            MLE_SUCCESS_MAX,
        ),
    ]


def _median(outcomes: Sequence[Outcome], quantity: str) -> float:
    return float(np.median([getattr(o, quantity) for o in outcomes]))


def _named(outcomes: Sequence[Outcome], name: str) -> list[Outcome]:
    return sorted((o for o in outcomes if o.name == name), key=lambda o: o.seed)
