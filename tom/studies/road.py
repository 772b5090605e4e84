"""Does TOM drive where MLE does not? Road-and-rocks over seeds, with controls and a sweep.

Trainings are judged by the acceptance. Controls must fail, or reverse, for the claim to be
meaningful. Simpler weightings are compared with TOM, and a sweep over the turn of the rocks shows
where the claim holds.
"""

from argparse import ArgumentParser, Namespace
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import takewhile
from math import nan
from statistics import median
from typing import Any

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from numpy.typing import NDArray

from tom import offline
from tom.config import RoadConfig
from tom.events import Collected, Evaluation, Event, Metrics, Weights
from tom.learners import follows_value
from tom.reports.figures import NEUTRAL, learner_colour, new_figure
from tom.reports.report import in_short
from tom.road import task
from tom.road.measure import returns
from tom.studies.study import (
    Findings,
    Row,
    add_jobs,
    check,
    compute,
)
from tom.studies.verdicts import by_acceptance

TITLE = "Road-and-rocks"
QUESTION = "Does TOM drive where offline MBPO does not, because the road counts more?"
CLAIM = (
    "On road-and-rocks TOM substantially outperforms offline MBPO, and does so because it gives "
    "the controllable region, the road, the higher weights (section 5.1)."
)
Array = NDArray[Any]
Kinds = Mapping[str, tuple[str, Mapping[str, Any]]]
"""learner and settings of trainings, by their name in the tables"""
MAIN: Kinds = {"mle": ("mle", {}), "tom": ("tom", {})}
CONTROLS: Kinds = {
    "labels swapped": ("labels-swapped", {}),
    "mle, mean-zero rocks": ("mle", {"turn": 0.0, "spread": 180.0}),
    "pmac, expert last": ("pmac", {}),
    "pmac, expert first": ("pmac", {"expert_first": True}),
}
"""what must fail, or reverse, if the claim is to be meaningful"""
SIMPLER = ("expert-only", "footprint-only", "ratio")
"""weightings without a dual"""
OTHERS: Kinds = {
    **{name: (name, {}) for name in ("vagram", *SIMPLER)},
    "tom, uniform starts": ("tom", {"rollout": {"weighted_starts": False}}),
}
TURNS = (0.0, 60.0, 90.0, 105.0, 120.0, 135.0, 150.0, 180.0)
"""mean turns of the sweep, degrees; the spread is half the turn"""
RATIO_MEDIAN, RATIO_MIN, SHARE_MIN = 10.0, 5.0, 0.85
EXPERT_ERROR_MAX, ROAD_ERROR_MAX = 0.35, 0.6
TOM_RETURN_MIN, TOM_SUCCESS_MIN, SEEDS_THAT_DRIVE = 0.8, 0.9, 0.75
MLE_RETURN_MAX, MLE_SUCCESS_MAX = 0.25, 0.2
SWAPPED_RATIO_MAX, MEAN_ZERO_RETURN_MIN = 3.0, -30.0
DRAWN = {"mle": ("mle", "MLE"), "pmac, expert last": ("pmac", "PMAC"), "tom": ("tom", "TOM")}
"""learner and label of the cases that are drawn"""
COLUMNS = {
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
"""of an outcome, by metric: errors in full steps, success as a share of episodes"""
CELLS = 25  # of a drawn map, along each side
EDGES = np.linspace(0, 1, CELLS + 1)
CENTRES = (EDGES[1:] + EDGES[:-1]) / 2
LEAST, MOST = 0.02, 50.0  # weights beyond these have the same colour

verdict = by_acceptance


def add_options(parser: ArgumentParser) -> None:
    parser.add_argument("--seeds", nargs="+", type="seed", default=list(range(8)), help="[0 .. 7]")
    parser.add_argument(
        "--sweep-seeds", nargs="+", type="seed", default=[4, 5], help="seeds of the sweep [4 5]"
    )
    add_jobs(parser)


def find(args: Namespace) -> Findings:
    main = [case for kinds in (MAIN, CONTROLS, OTHERS) for case in cases(kinds, args.seeds)]
    swept = [  # only the planner, which tests the model
        replace(case, config=case.config.but(turn=turn, spread=turn / 2), optimise=False)
        for turn in TURNS
        for case in cases(MAIN, args.sweep_seeds)
    ]
    results = compute(
        args,
        run_case,
        [*main, *swept],
        lambda story: "{name} seed {seed} turn {turn:g}".format(**story.outcome),
    )
    stories, sweep = results[: len(main)], [story.outcome for story in results[len(main) :]]
    outcomes = [story.outcome for story in stories]
    first = {story.outcome["name"]: story for story in reversed(stories)}
    weighed = {label: first[name] for name, (_, label) in DRAWN.items()}
    return Findings(
        sentences=in_sentences(outcomes, sweep),
        files={
            "outcomes": outcomes,
            "sweep": sweep,
            "returns": _returns(stories),
            "weights": weight_rows(weighed),
        },
        titles={"outcomes": "By seed"},
        figures={
            "returns": ("Return in the real task, single seeds faint", return_figure(stories)),
            "sweep": ("The planner's return as the rocks turn more", sweep_figure(sweep)),
            "weights": ("Mean weight over the map", weight_figure(weighed)),
        },
        checks=[*acceptance(outcomes), *controls(outcomes)],
        origin={
            "n": f"{len(main)} trainings of {len(first)} learners and controls",
            "seeds": in_short(args.seeds),
        },
    )


@dataclass(frozen=True)
class Case:
    """A configuration and its name in the tables."""

    name: str
    config: RoadConfig
    optimise: bool = True
    """if false, SAC is left out: only the weights, the model and its planner"""


def cases(kinds: Kinds, seeds: Sequence[int]) -> list[Case]:
    """Each kind of training with each seed."""
    return [
        Case(name, RoadConfig(learner=learner, seed=seed).but(**changes), name != "labels swapped")
        for seed in seeds
        for name, (learner, changes) in kinds.items()
    ]


@dataclass(frozen=True)
class CaseResult:
    """An outcome with the curve of returns and the weights."""

    outcome: Row
    returns: list[tuple[int, float]]  # (step of policy optimisation, mean return)
    places: NDArray[np.float32]  # (N, 2) of the transitions
    weights: NDArray[np.float32]  # (N,)


def run_case(case: Case) -> CaseResult:
    """Run a case.

    What was not measured is NaN: SAC if it was left out, and the planner of a learner that follows
    the value function, because it drives only once, before there is a value function.
    """
    events: Iterator[Event] = offline.Offline(case.config).events()
    if not case.optimise:
        events = takewhile(lambda event: event.env_step == 0, events)
    values: dict[str, float] = {}
    curve: list[tuple[int, float]] = []
    sac, places, weights = (nan, nan), np.zeros((0, 2), np.float32), np.zeros(0, np.float32)
    for event in events:
        match event:
            case Metrics():
                values |= event.values
            case Evaluation():
                sac = returns(event.episodes)
                curve.append((event.env_step, sac[0]))
            case Collected():
                places = np.asarray(event.transitions.obs, np.float32)
            case Weights():
                weights = event.weight
    outcome: Row = {"name": case.name, "seed": case.config.seed, "turn": case.config.turn}
    outcome |= {name: values[path] for name, path in COLUMNS.items()}
    if follows_value(case.config.learner):
        outcome |= {"planner_return": nan, "planner_success": nan}
    sac = sac if case.optimise else (nan, nan)
    return CaseResult(
        outcome | {"sac_return": sac[0], "sac_success": sac[1]}, curve, places, weights
    )


def _named(outcomes: Sequence[Row], name: str) -> list[Row]:
    return sorted((o for o in outcomes if o["name"] == name), key=lambda o: o["seed"])


def _median(outcomes: Sequence[Row], quantity: str) -> float:
    return float(median(o[quantity] for o in outcomes))


def normalised(o: Row, value: float) -> float:
    """(R - R_random) / (R_expert - R_random)."""
    return (value - o["return_random"]) / (o["return_expert"] - o["return_random"])


def acceptance(outcomes: Sequence[Row]) -> list[Row]:
    """The checks of the claim, from MLE's and TOM's outcomes with the same seeds."""
    tom, mle = _named(outcomes, "tom"), _named(outcomes, "mle")
    ratio, share = [o["road_ratio"] for o in tom], [o["road_share"] for o in tom]

    def over(error: str) -> list[float]:
        return [t[error] / m[error] for t, m in zip(tom, mle, strict=True)]

    checks = [
        check("weight ratio road / rocks, median", median(ratio), ">=", RATIO_MEDIAN),
        check("weight ratio road / rocks, minimum", min(ratio), ">=", RATIO_MIN),
        check("share of weight on the road", min(share), ">=", SHARE_MIN),
        check("error on expert data over MLE's", max(over("error_expert")), "<=", EXPERT_ERROR_MAX),
        check("error on the road over MLE's", max(over("error_road")), "<=", ROAD_ERROR_MAX),
        check("error on rocks over MLE's", min(over("error_rocks")), ">=", 1.0),
    ]
    for kind in ("sac", "planner"):
        reward, success = f"{kind}_return", f"{kind}_success"
        drives = [
            normalised(o, o[reward]) >= TOM_RETURN_MIN and o[success] >= TOM_SUCCESS_MIN
            for o in tom
        ]
        stuck = [
            normalised(o, o[reward]) <= MLE_RETURN_MAX and o[success] <= MLE_SUCCESS_MAX
            for o in mle
        ]
        driving, standing = float(np.mean(drives)), float(np.mean(stuck))
        checks += [
            check(f"share of seeds where TOM drives ({kind})", driving, ">=", SEEDS_THAT_DRIVE),
            check(f"share of seeds where MLE does not ({kind})", standing, ">=", 1.0),
        ]
    return checks


def controls(outcomes: Sequence[Row]) -> list[Row]:
    """The checks of the controls."""
    ratio = [o["road_ratio"] for o in _named(outcomes, "labels swapped")]
    planner, sac = (
        _median(_named(outcomes, "mle, mean-zero rocks"), f"{kind}_return")
        for kind in ("planner", "sac")
    )
    last, first = (
        _median(_named(outcomes, f"pmac, expert {place}"), "planner_success")
        for place in ("last", "first")
    )
    pmac = "PMAC, expert data stored {}: success (planner)"
    return [
        check("labels swapped: weight ratio, median", median(ratio), "<=", SWAPPED_RATIO_MAX),
        check("labels swapped: weight ratio, maximum", max(ratio), "<=", SWAPPED_RATIO_MAX),
        check("mean-zero rocks: MLE's return (planner)", planner, ">=", MEAN_ZERO_RETURN_MIN),
        check("mean-zero rocks: MLE's return (sac)", sac, ">=", MEAN_ZERO_RETURN_MIN),
        check(pmac.format("last"), last, ">=", TOM_SUCCESS_MIN),
        check(pmac.format("first"), first, "<=", MLE_SUCCESS_MAX),
    ]


def in_sentences(outcomes: Sequence[Row], sweep: Sequence[Row]) -> list[str]:
    """How often TOM beats MLE and weighs the road, what else does so, and where MLE is enough."""
    tom, mle = _named(outcomes, "tom"), _named(outcomes, "mle")
    sentences = []
    for quantity, what in (
        ("sac_return", "return is above MLE's"),
        ("road_share", "share of weight on the road is above MLE's"),
    ):
        above = sum(t[quantity] > m[quantity] for t, m in zip(tom, mle, strict=True))
        sentences.append(
            f"TOM's {what} on {above} of {len(tom)} seeds (median {_median(tom, quantity):.2f} "
            f"against {_median(mle, quantity):.2f})."
        )
    simpler = [
        name
        for name in (*SIMPLER, "pmac, expert last")
        if _median(_named(outcomes, name), "sac_success") >= TOM_SUCCESS_MIN
    ]
    if simpler:
        sentences.append(
            f"What the paper leaves out: {', '.join(simpler)} arrive as well, so the task does not "
            "show that TOM's dual is what helps."
        )
    by_turn: dict[float, list[Row]] = {}
    for o in _named(sweep, "mle"):
        by_turn.setdefault(o["turn"], []).append(o)
    arrives = [t for t, of in by_turn.items() if _median(of, "planner_success") >= TOM_SUCCESS_MIN]
    if arrives:
        sentences.append(
            "The paper does not say how much its rocks turn the steering: at "
            f"{', '.join(f'{turn:g}' for turn in sorted(arrives))} degrees the planner arrives in "
            "MLE's model, too, and the claim does not hold."
        )
    return sentences


def _returns(stories: Sequence[CaseResult]) -> Iterator[Row]:
    for story in stories:
        of = {"name": story.outcome["name"], "seed": story.outcome["seed"]}
        for step, value in story.returns:
            yield {**of, "step": step, "return": value}


def return_figure(stories: Sequence[CaseResult]) -> Figure:
    """Return against steps of policy optimisation in the model."""
    drawn = {}
    for name, (learner, label) in DRAWN.items():
        curves = np.array([s.returns for s in stories if s.outcome["name"] == name])  # (S, T, 2)
        drawn[f"{label} (n = {len(curves)})"] = learner, curves[0, :, 0], curves[:, :, 1]
    figure = _curves(drawn, "steps of policy optimisation in the model", "return in the real task")
    expert = [s.outcome["return_expert"] for s in stories]
    figure.axes[0].axhline(float(np.mean(expert)), color=NEUTRAL, linestyle="--", linewidth=0.8)
    return figure


def sweep_figure(outcomes: Sequence[Row]) -> Figure:
    """The planner's return in each learner's model as the rocks turn more."""
    drawn = {}
    for name in MAIN:
        reward = np.array([o["planner_return"] for o in _named(outcomes, name)])  # seed by seed
        drawn[name.upper()] = name, np.array(TURNS), reward.reshape(-1, len(TURNS))
    what = "mean turn of the steering on rocks, degrees"
    return _curves(drawn, what, "return of the planner")


def _curves(drawn: Mapping[str, tuple[str, Array, Array]], x_label: str, y_label: str) -> Figure:
    """A learner's x (T,) and values (S, T) under each label: their mean, single seeds faint."""
    figure = new_figure(5.2, 3.2)
    ax = figure.subplots()
    for label, (learner, x, values) in drawn.items():
        colour = learner_colour(learner)
        ax.plot(x, values.T, color=colour, alpha=0.3, linewidth=0.7)
        ax.plot(x, values.mean(0), color=colour, label=label)
    ax.set(xlabel=x_label, ylabel=y_label)
    ax.legend()
    return figure


def weight_figure(drawn: Mapping[str, CaseResult]) -> Figure:
    """Mean weight in each cell of the map, a panel for each learner."""
    figure = new_figure(3.1 * len(drawn) + 0.6, 3.3)
    axes = figure.subplots(1, len(drawn), squeeze=False)[0]
    norm = LogNorm(LEAST, MOST)
    for ax, (label, story) in zip(axes, drawn.items(), strict=True):
        shown = np.clip(_cells(story)[0].T, LEAST, MOST)
        ax.pcolormesh(EDGES, EDGES, shown, cmap="inferno", norm=norm)
        ax.plot(*np.array(task.CENTRE_LINE).T, color="white", linewidth=1, linestyle=":")
        ax.set_title(f"{label}, seed {story.outcome['seed']}")
        ax.set(aspect="equal", xticks=[], yticks=[])
    bar = ScalarMappable(norm, "inferno")
    figure.colorbar(bar, ax=list(axes), label="mean weight", shrink=0.8)
    return figure


def weight_rows(drawn: Mapping[str, CaseResult]) -> Iterator[Row]:
    """The drawn data: one row per learner and cell with transitions."""
    for label, story in drawn.items():
        mean, count = _cells(story)
        for i, j in zip(*np.nonzero(count), strict=True):
            yield {
                "learner": label,
                "seed": story.outcome["seed"],
                "x": CENTRES[i],
                "y": CENTRES[j],
                "transitions": int(count[i, j]),
                "mean weight": mean[i, j],
            }


def _cells(story: CaseResult) -> tuple[Array, Array]:
    """Mean weight (NaN for empty cells) and number of transitions; (x, y), (CELLS, CELLS) each."""
    x, y = story.places.T
    total = np.histogram2d(x, y, [EDGES, EDGES], weights=story.weights)[0]
    count = np.histogram2d(x, y, [EDGES, EDGES])[0]
    mean = np.divide(total, count, out=np.full_like(total, np.nan), where=count > 0)
    return mean, count
