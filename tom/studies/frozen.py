"""Frozen buffers: every way of weighing applied to a run's buffer as it was at one of its fits.

A moment is the replay buffer of a run at a fit, with the stored policy of that fit. Online,
learners differ in policy, data and model at once; at a moment they differ only in their weights.
The learner gets the same information as online, the newest transitions of a changing policy; it is
tested on fresh episodes of the policy of that fit.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from math import inf
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from tom.analysis.ordered_data import OrderedData, load_run
from tom.analysis.weighing import fit_model, fit_weights
from tom.config import OnlineConfig
from tom.data.datasets import initial_obs
from tom.data.sampling import ess
from tom.data.transitions import TensorTransitions
from tom.dynamics import DynamicsModel
from tom.envs import task
from tom.errors import UserError
from tom.exams.diagnostics import one_step_error, rollout_error, rollout_starts, step_scale
from tom.exams.energy import footprint_match, step_scaling
from tom.learners import follows_behaviour
from tom.learners.base import Weighting
from tom.policy.collect import footprint
from tom.policy.stored import StoredPolicy, read_policy
from tom.record import RunReader, layout
from tom.rng import Streams
from tom.spread import spread
from tom.studies.study import Row, say
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
    label: str = ""
    """its name for people; without one it is a variant of a flow, and only tables name it"""
    half: bool = False
    """half of its weight is uniform"""


def _tom(**settings: Any) -> Way:
    return Way("tom", {"tom": settings})


VALIDATED: Mapping[str, Any] = {"q_holdout": 0.2, "q_steps": 2000, "q_check_every": 25}
PRINTED, MENDED = "tom-discounted", "tom-mended"
HALVED = {"recency", "ratio", "pdml", "policy-distance", "pmer", "action-ratio", MENDED}
"""the ways that are also mixed half and half with uniform weights"""
WAYS: dict[str, Way] = {}
"""Q starts anew except in the recorded run"""
for _name, _way in {
    UNIFORM: Way("mle", label="MLE (uniform)"),
    "newest": Way(None, label="newest seventh"),
    "recency": Way("pmac", label="PMAC (recency)"),
    "vagram": Way("vagram", label="VaGram"),
    "ratio": Way("ratio", label="ratio"),
    "pdml": Way("pdml", label="PDML"),
    "policy-distance": Way("policy-distance", label="policy distance"),
    "pmer": Way("pmer", label="PMER"),
    "action-ratio": Way("action-ratio", label="action ratio"),
    "tom-released": Way("tom", preset="released", label="TOM as released"),
    PRINTED: replace(_tom(q_reset=True), label="TOM as printed"),
    "tom-discounted-validated": _tom(**VALIDATED),
    "tom-restart": _tom(q_reset=True, flow="restart"),
    "tom-restart-validated": _tom(flow="restart", **VALIDATED),
    "tom-stationary": _tom(q_reset=True, flow="stationary"),
    "tom-stationary-validated": _tom(flow="stationary", **VALIDATED),
    "tom-stationary-kl": _tom(q_reset=True, flow="stationary", divergence="kl"),
    MENDED: Way("tom", preset="mended", label="TOM mended"),
}.items():
    WAYS[_name] = _way
    if _name in HALVED:
        WAYS[f"half-{_name}"] = replace(
            _way,
            settings={place: {"uniform_share": 0.5} for place in ("model", "rollout")},
            label=f"half {_way.label.partition(' (')[0]} + half uniform",
            half=True,
        )
LABELS = {name: way.label for name, way in WAYS.items() if way.label}
OF_TOM = {"TOM": PRINTED, "TOM, mended": MENDED}
"""the ways of whole trainings, by what tables of them call TOM's"""

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
    first = first_sac_step(run) + NEWEST
    steps = [step for step in run.policy_steps() if step >= first]
    return [steps[i] for i in spread(len(steps), most)]


def first_sac_step(run: RunReader) -> float:
    """The step from which on SAC's policy acts; infinity if the run's settings do not say.

    That is after exploration, in a recording of SAC also after as many random steps as of SAC.
    """
    named = ("exploration_steps",) if run.fits_model else ("exploration_steps", "steps")
    try:
        return sum(run.config["config"][name] for name in named)
    except KeyError:
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
    updates: int = 1250  # of SAC (`improvement`): those between two fits of the paper's preset
    episodes: int = 5  # of an evaluation

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
        missing = f"{len(lacking)} of {len(runs)} runs do not say which policies drew their actions"
        if len(lacking) == len(runs) and {UNIFORM, *needing} >= set(ways):
            raise UserError(f"{missing}: record again, or name other --ways")
        say(f"{missing}: left out of {', '.join(needing)}")
    return [
        Case(run.path, step, way, seed, tuple(models), rows, run.created)
        for run in runs
        for step in moments(run, most)
        for seed in seeds
        for way in ways
        if run not in lacking or way not in needing
    ]


def outcome_columns(case: Case, run: RunReader) -> Row:
    """The columns of an outcome that say whose it is."""
    of = {"step": case.step, "way": case.way, "seed": case.seed}
    return {"recording": run.run_id, "env": run.env} | of


def examine(case: Case) -> Row:
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
    found = outcome_columns(case, run) | {
        "ess": ess(weights),
        "ends": float((weights * rows.terminated).sum() / weights.sum()),
        "ends_policy": float(anew.terminated.mean()),
    }
    for name in ("footprint", "footprint_uniform", "footprint_noise"):
        found[name] = match.get(name, np.nan)
    scale, starts = step_scale(rows), rollout_starts(anew)
    for name in case.models:
        model = fit_named_model(name, rows, weighting, config)
        found[ERROR + name] = one_step_error(model, anew, scale)
        found[ROLLOUT_ERROR + name] = rollout_error(model, anew, starts, scale)
    return found


@lru_cache(maxsize=1)  # a process gets the ways of a moment one after the other
def _moment(case: Case) -> tuple[OrderedData, StoredPolicy, TensorTransitions, Tensor]:
    """What all ways share: buffer, policy, its fresh transitions, and their generator's state."""
    run, streams = RunReader(case.run), Streams(case.stream_seed)
    policy = policy_at(run, case.step)
    start, generator = streams.integer("test env"), streams.torch("test")
    anew = footprint(task(run.env), policy, case.rows, start, generator).transitions.torch()
    return buffer_at(run, case.step), policy, anew, generator.get_state()


def policy_at(run: RunReader, step: int) -> StoredPolicy:
    """The policy that was kept at a fit. Raises UserError if its file is damaged."""
    return read_policy(run.path / layout.policy(step))


def buffer_at(run: RunReader, step: int) -> OrderedData:
    """The replay buffer of a training at `step`, or its counterpart in a recording of SAC."""
    if run.fits_model:
        return load_run(run, step)
    data = load_run(run)
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


def fit_named_model(
    name: str, rows: TensorTransitions, weighting: Weighting, config: OnlineConfig
) -> DynamicsModel:
    """The model `name` of MODELS, fitted to the rows with these weights."""
    return fit_model(rows, weighting, config.model.but(**MODELS[name]), config.seed)
