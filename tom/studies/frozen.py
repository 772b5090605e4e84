"""Frozen buffers: every way of weighing applied to a run's buffer as it was at one of its fits.

A moment is the replay buffer of a run at a fit, with the stored policy of that fit. Online,
learners differ in policy, data and model at once; at a moment they differ only in their weights.
The learner gets the same information as online, the newest transitions of a changing policy; it is
tested on fresh episodes of the policy of that fit.
"""

import json
from argparse import ArgumentParser, Namespace
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from math import inf
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from tom.analysis.ordered_data import OrderedData, of_run
from tom.analysis.weighing import fit_model, fit_weights
from tom.config import OnlineConfig
from tom.data.datasets import initial_obs
from tom.data.sampling import ess
from tom.data.transitions import TensorTransitions
from tom.dynamics import DynamicsModel
from tom.envs import ENVS, ROAD, task, task_rank
from tom.errors import UserError, reason
from tom.exams.diagnostics import one_step_error, rollout_error, step_scale, unbroken
from tom.exams.energy import footprint_match, step_scaling
from tom.learners import follows_behaviour
from tom.learners.base import Weighting
from tom.policy.collect import footprint
from tom.policy.stored import StoredPolicy, read_policy
from tom.record import RunReader, Store, layout
from tom.reports.report import WORDS
from tom.reports.report import seeds as in_short
from tom.rng import Streams
from tom.studies.study import (
    Lab,
    Row,
    add_env,
    add_jobs,
    add_store,
    check_known,
    say,
    tasks,
    whole,
)
from tom.training.presets import resolve

NEWEST = 1000  # rows of the policy buffer
RANDOM = 5000  # random rows before those of a SAC recording, as in a training's exploration
UNIFORM = "uniform"
"""the way of weighing that every other is compared with"""


@dataclass(frozen=True)
class Way:
    """A way of weighing: a learner with a preset and settings; None: only the newest rows."""

    learner: str | None
    settings: Mapping[str, Any] = field(default_factory=dict)
    preset: str = "paper"


def _tom(**settings: Any) -> Way:
    return Way("tom", {"tom": settings})


VALIDATED: Mapping[str, Any] = {"q_holdout": 0.2, "q_steps": 2000, "q_check_every": 25}
HALF: Mapping[str, Any] = {"model": {"uniform_share": 0.5}, "rollout": {"uniform_share": 0.5}}

WAYS: dict[str, Way] = {
    UNIFORM: Way("mle"),
    "newest": Way(None),
    "recency": Way("pmac"),
    "half-recency": Way("pmac", HALF),
    "vagram": Way("vagram"),
    "ratio": Way("ratio"),
    "half-ratio": Way("ratio", HALF),
    "pdml": Way("pdml"),
    "half-pdml": Way("pdml", HALF),
    "policy-distance": Way("policy-distance"),
    "half-policy-distance": Way("policy-distance", HALF),
    "pmer": Way("pmer"),
    "half-pmer": Way("pmer", HALF),
    "action-ratio": Way("action-ratio"),
    "half-action-ratio": Way("action-ratio", HALF),
    "tom-released": Way("tom", preset="released"),
    "tom-discounted": _tom(q_reset=True),
    "tom-discounted-validated": _tom(**VALIDATED),
    "tom-restart": _tom(q_reset=True, flow="restart"),
    "tom-restart-validated": _tom(flow="restart", **VALIDATED),
    "tom-stationary": _tom(q_reset=True, flow="stationary"),
    "tom-stationary-validated": _tom(flow="stationary", **VALIDATED),
    "tom-stationary-kl": _tom(q_reset=True, flow="stationary", divergence="kl"),
    "tom-mended": Way("tom", preset="mended"),
    "half-tom-mended": Way("tom", HALF, preset="mended"),
}
"""half: mixed half and half with uniform weights; Q starts anew except in the recorded run"""

MODELS: dict[str, Mapping[str, Any]] = {
    "linear": {"kind": "linear"},
    "8 x 2": {"hidden": 8, "layers": 2},
    "32 x 2": {"hidden": 32, "layers": 2},
    "200 x 4": {"hidden": 200, "layers": 4},
}
"""models of growing capacity, the last one the paper's; networks are mixture density networks"""
ERROR, ROLLOUT_ERROR = "error ", "rollout error "
"""the beginnings of the columns of a model's errors"""


def moments(run: RunReader, most: int) -> list[int]:
    """At most `most` fits, evenly spread, whose policy was stored, after the policy was in use."""
    first = sac_begins(run) + NEWEST
    steps = [step for step in run.policy_steps() if step >= first]
    if len(steps) <= most:
        return steps
    return [steps[round(i)] for i in np.linspace(0, len(steps) - 1, most)]


def sac_begins(run: RunReader) -> float:
    """The step from which on SAC's policy acts; infinity if the run's settings do not say.

    That is after exploration, in a recording of SAC also after as many random steps as of SAC.
    """
    named = ("exploration_steps",) if run.fits_model else ("exploration_steps", "steps")
    try:
        return sum(run.config["config"][name] for name in named)
    except (KeyError, TypeError):
        return inf


@dataclass(frozen=True)
class Case:
    """One way of weighing at one moment with one seed; `models` are fitted with those weights."""

    run: Path
    step: int
    way: str
    seed: int = 0
    models: tuple[str, ...] = ()
    rows: int = 6000  # fresh transitions of the policy
    made: str = ""  # time of creation: a new run under the same path is another case

    @property
    def stream_seed(self) -> int:
        """The seed of the case's random streams: ways of weighing share it, moments do not."""
        return Streams(self.seed).integer(f"{self.run.name} at {self.step}")


def cases(
    runs: Sequence[RunReader],
    ways: Sequence[str],
    seeds: Sequence[int],
    most: int,
    models: Sequence[str] = (),
    rows: int = 6000,
) -> list[Case]:
    """Every way with every seed at every moment of every run.

    A run that does not say which policies drew its actions is left out of the ways that need them.
    Raises UserError if all are left out of all but uniform weights.
    """
    needing = [way for way in ways if follows_behaviour(WAYS[way].learner or "")]
    lacking = [run for run in runs if needing and not run.keeps_behaviour()]
    if lacking:
        told = f"{len(lacking)} of {len(runs)} runs do not say which policies drew their actions"
        if len(lacking) == len(runs) and {UNIFORM, *needing} >= set(ways):
            raise UserError(f"{told}: record anew, or name other --ways")
        say(f"{told}: left out of {', '.join(needing)}")
    return [
        Case(run.path, step, way, seed, tuple(models), rows, run.created)
        for run in runs
        for step in moments(run, most)
        for seed in seeds
        for way in ways
        if run not in lacking or way not in needing
    ]


def examined(case: Case) -> Row:
    """Weigh the moment's buffer, and test the weights and the models fitted with them.

    `ess` and `ends` are the shares of the effective sample and of the weight on transitions that
    end an episode, `ends_policy` that of the policy; footprints are those of `footprint_match`. A
    model's errors one step and five steps ahead on fresh steps of the policy are in standard
    deviations of a step's change.
    """
    run, way = RunReader(case.run), WAYS[case.way]
    data, policy, anew, state = _moment(replace(case, way="", models=()))
    rows, config = data.transitions, config_of(run, way, case.stream_seed)
    weighting = weighting_of(data, policy, config, way)
    weights = weighting.counted(config.model)
    # Each way goes on with the random numbers that follow the fresh transitions.
    generator = torch.Generator().set_state(state)
    match = footprint_match(rows, weights, anew, step_scaling(rows), generator)
    found = {
        "recording": run.run_id,
        "env": run.env,
        "step": case.step,
        "way": case.way,
        "seed": case.seed,
        "ess": ess(weights),
        "ends": float((weights * rows.terminated).sum() / weights.sum()),
        "ends_policy": float(anew.terminated.mean()),
    }
    for name in ("footprint", "footprint_uniform", "footprint_noise"):
        found[name] = match.get(name, np.nan)
    scale, starts = step_scale(rows), unbroken(anew)
    for name in case.models:
        model = fitted(name, rows, weighting, config)
        found[ERROR + name] = one_step_error(model, anew, scale)
        found[ROLLOUT_ERROR + name] = rollout_error(model, anew, starts, scale)
    return found


@lru_cache(maxsize=1)  # a process gets the ways of a moment one after the other
def _moment(case: Case) -> tuple[OrderedData, StoredPolicy, TensorTransitions, Tensor]:
    """What all ways share: buffer, policy, its fresh transitions, and their generator's state."""
    run, streams = RunReader(case.run), Streams(case.stream_seed)
    policy = read_policy(case.run / layout.policy(case.step))
    start, generator = streams.integer("test env"), streams.torch("test")
    anew = footprint(task(run.env), policy, case.rows, start, generator).transitions.torch()
    return buffer_at(run, case.step), policy, anew, generator.get_state()


def buffer_at(run: RunReader, step: int) -> OrderedData:
    """The replay buffer of a training at `step`, or its counterpart in a recording of SAC."""
    if run.fits_model:
        return of_run(run, step)
    data = of_run(run)
    first = max(data.ordered_from - RANDOM, 0)
    rows = data.transitions[first:step]
    return replace(
        data,
        transitions=rows,
        policy_version=data.policy_version[first:step],
        behaviour=None if data.behaviour is None else data.behaviour[first:step],
        # Of all episodes begun so far: the first row that is left begins none.
        initial_obs=torch.as_tensor(initial_obs(data.transitions[:step])),
        ordered_from=data.ordered_from - first,
    )


def config_of(run: RunReader, way: Way, seed: int) -> OnlineConfig:
    """The settings of a way of weighing in the run's task."""
    config = resolve(run.env, way.learner or "mle", way.preset, {**way.settings, "seed": seed})
    assert isinstance(config, OnlineConfig)
    return config


def weighting_of(
    data: OrderedData, policy: StoredPolicy, config: OnlineConfig, way: Way
) -> Weighting:
    """The weights of an online fit with `config` (`config_of`), from newly initialised networks."""
    rows = data.transitions
    if way.learner is None:
        weights = torch.zeros(len(rows))
        weights[-NEWEST:] = len(rows) / NEWEST
        return Weighting(weights)
    steps = len(rows) - data.ordered_from
    return fit_weights(data, policy, rows[-NEWEST:], steps, config)


def fitted(
    name: str, rows: TensorTransitions, weighting: Weighting, config: OnlineConfig
) -> DynamicsModel:
    """The model `name` of MODELS, fitted to the rows with these weights."""
    return fit_model(rows, weighting, config.model.but(**MODELS[name]), config.seed)


# The choice of moments, and the table of their outcomes.

OF_MEASURING = ("env", "moments", "seeds", "ways", "store", "jobs", "rows", "models")
"""the options that say what is measured and how"""
KINDS: Mapping[Any, Any] = {"recording": str, "env": str, "step": int, "way": str, "seed": int}
MEASURES = ("ess", "ends", "ends_policy", "footprint", "footprint_uniform", "footprint_noise")
"""the columns of an outcome: the types of those that are no measures, and the measures"""
MEASURED = "measured: "
"""begins what a report that was made anew says of the origin of its outcomes"""


def add_moments(parser: ArgumentParser, ways: Sequence[str]) -> None:
    """Add the options that choose runs, their moments, and ways of weighing."""
    parser.add_argument("runs", nargs="*", metavar="RUN", help="[all of the store that can]")
    add_env(parser, list(ENVS), "[all of ours]")
    parser.add_argument("--moments", type=whole(1), default=8, help="of each run at most [8]")
    parser.add_argument("--seeds", nargs="+", type="seed", default=[0], help="[0]")
    known = ", ".join(WAYS)
    parser.add_argument("--ways", nargs="+", default=list(ways), metavar="WAY", help=known)
    add_store(parser)
    add_jobs(parser)


def chosen_ways(args: Namespace) -> list[str]:
    """The ways of weighing, uniform weights first. Raises UserError for an unknown one."""
    check_known("way of weighing", args.ways, WAYS)
    return list(dict.fromkeys((UNIFORM, *args.ways)))


def chosen_runs(args: Namespace) -> list[RunReader]:
    """The runs with moments, of any task.

    Raises UserError if there are none, or a named run has none or is of a task that is not known.
    """
    store, envs = Store(args.store), tasks(args.env)
    named = [store.run(name) for name in args.runs]
    for run in named:
        if not _usable(run):
            raise UserError(
                f"run {run.run_id} has no moment: it kept no policy of its fits, or no buffer, or "
                f"it ended less than {NEWEST:,} steps after its exploration"
            )
        task(run.env)
    runs = named or [run for run in store.runs() if run.env in envs and _usable(run)]
    if not runs:
        raise UserError(
            f"{args.store}/ has no run with a buffer and policies of fits at least {NEWEST:,} "
            "steps after exploration: "
            f"tom record-sac --env {min(envs, key=task_rank)} --steps 20000 makes one"
        )
    return sorted(runs, key=lambda run: (task_rank(run.env), run.run_id))


def _usable(run: RunReader) -> bool:
    has_both = not {"buffer", "policies"} & set(run.left_out)
    return run.is_run and run.env != ROAD and has_both and bool(moments(run, 1))


def add_measuring(parser: ArgumentParser, ways: Sequence[str], models: Sequence[str] = ()) -> None:
    """Add the options of a study that weighs moments, or reads the table of one that did."""
    add_moments(parser, ways)
    parser.add_argument("--rows", type=whole(100), default=6000, help="new transitions [6000]")
    if models:
        known = ", ".join(f"'{name}'" for name in models)
        parser.add_argument("--models", nargs="+", default=list(models), help=f"[{known}]")
    parser.set_defaults(usual={name: parser.get_default(name) for name in OF_MEASURING})
    parser.add_argument(
        "--from", dest="table", type=Path, metavar="FILE",
        help="moments.csv of an earlier report: only its tables and figures are made anew",
    )  # fmt: skip


def measured(args: Namespace, lab: Lab, models: Sequence[str] = ()) -> list[Row]:
    """The outcome of every case, or those of an earlier report.

    Raises UserError for options that have no meaning if nothing is measured.
    """
    if not args.table:
        asked = cases(
            chosen_runs(args), chosen_ways(args), args.seeds, args.moments, models, args.rows
        )
        return lab.compute(
            examined, asked, lambda one: f"{one['recording']} at {one['step']}: {one['way']}"
        )
    given = [name for name, usual in args.usual.items() if getattr(args, name, None) != usual]
    if too_many := [*(f"--{option}" for option in given), *args.runs]:
        raise UserError(
            "--from takes all that its file holds, as it was measured: leave out "
            f"{' '.join(too_many)}"
        )
    return read_outcomes(args.table, bool(models))


def read_outcomes(path: Path, models: bool) -> list[Row]:
    """The outcomes of `moments.csv` beside a report, to the bit.

    Raises UserError if `path` cannot be read, is no such table, or lacks the errors of `models`.
    """
    try:
        table = pd.read_csv(path, dtype=KINDS, float_precision="round_trip")
    except OSError as error:
        raise UserError(f"cannot read {path}: {error}") from error
    except ValueError as error:
        raise UserError(f"{path} is no moments.csv of this study ({reason(error)})") from error
    outcomes = [dict(row) for row in table.to_dict("records")]
    lacking = {*KINDS, *MEASURES}.difference(table) or table.empty
    if lacking or (models and not models_of(outcomes)):
        raise UserError(f"{path} has no outcome of this study: name the moments.csv of its report")
    return outcomes


def models_of(outcomes: Sequence[Row]) -> list[str]:
    """The models whose errors the outcomes have."""
    columns = dict.fromkeys(name for one in outcomes for name in one if name.startswith(ERROR))
    return [name.removeprefix(ERROR) for name in columns]


def origin_of_moments(outcomes: Sequence[Row], table: Path | None = None) -> dict[str, str]:
    """The number of moments, the seeds and runs, and how a table was measured that was read."""
    recordings = dict.fromkeys(one["recording"] for one in outcomes)
    origin = {
        "n": f"{len({(one['recording'], one['step']) for one in outcomes})} moments of "
        f"{len(recordings)} runs",
        "seeds": in_short([one["seed"] for one in outcomes]),
        "runs": ", ".join(recordings),
    }
    if table is None:
        return origin
    try:  # the report beside it
        old = dict(json.loads((table.parent / WORDS).read_text())["origin"])
    except (OSError, ValueError, KeyError, TypeError):
        return origin
    first = {key: text for key, text in old.items() if key.startswith(MEASURED)}
    return origin | (first or {MEASURED + key: text for key, text in old.items()})
