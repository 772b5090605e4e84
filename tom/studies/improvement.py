"""Does weighting make better policies? What one model does for the policy, moment by moment.

At a moment of a frozen buffer (`tom.studies.frozen`) soft actor-critic goes on from the stored
policy and critics, on rollouts in a model fitted to this buffer. A learner's weights act in two
places: the fit of the model (Algorithm 2, lines 15-18) and the start states of its rollouts (line
22). So every way of weighing acts in the model alone, in the starts alone, and in both, with
the same random numbers each time. Whole runs differ in data as well, and take hours.

It differs from a training: the networks of the model are new, so are SAC's optimisers and target
critics, all modelled rows come from this one model (a training keeps those of four fits), and
settings other than SAC's are those of the `paper` preset, as for the other studies of moments.
What ends a modelled episode is the rule of the run; if it has none, a head fitted to the whole
buffer, unweighted.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from statistics import mean
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tom.analysis.curves import curve_points
from tom.config import OnlineConfig, SacConfig
from tom.data.replay import ReplayBuffer
from tom.data.transitions import TensorTransitions
from tom.data.unpack import DAMAGE, read_arrays
from tom.dynamics import DynamicsModel
from tom.dynamics.ending import EndingHead
from tom.envs import Termination, task
from tom.envs.ends import learns_ends, rule
from tom.errors import UserError, reason
from tom.learners.base import Weighting
from tom.policy.batches import mixed_batches
from tom.policy.evaluate import Evaluator
from tom.policy.rollout import roll_out, start_states
from tom.policy.sac import Sac
from tom.policy.stored import CRITIC, StoredPolicy, resumed_sac
from tom.record import RunReader, layout
from tom.rng import Streams
from tom.studies.footprint import UNIFORM
from tom.studies.frozen import (
    WAYS,
    Case,
    buffer_at,
    config_of,
    fitted,
    sac_begins,
    seed_of,
    weighting_of,
)

PARTS = 5
"""evaluations of the policy, evenly spread over its updates"""
TEMPERATURE = "temperature/value"


@dataclass(frozen=True)
class Trial:
    """A case with one model, the number of SAC updates, and the episodes of an evaluation."""

    case: Case
    updates: int = 1250  # those between two fits of the paper's preset
    episodes: int = 5


@dataclass(frozen=True)
class Improvement:
    """Mean-action returns: before the updates, and during them, mean over `PARTS` evaluations.

    `model`, `starts` and `both` say where the weights acted; with uniform weights they are the same
    trial. NaN: SAC diverged.
    """

    recording: str
    env: str
    step: int
    way: str
    seed: int
    before: float
    model: float
    starts: float
    both: float


def goes_on(run: RunReader) -> bool:
    """Whether SAC can go on from the run's policies: those of earlier versions have no critics.

    Raises UserError if a policy is damaged.
    """
    return all(f"{CRITIC}weight_0" in _arrays(run, step) for step in run.policy_steps())


def rule_of(run: RunReader) -> str | None:
    """The name of the rule that ended the run's modelled episodes; None: the task's own."""
    return run.config["config"].get("model", {}).get("termination")


def improved(trial: Trial) -> Improvement:
    """Update the policy of a moment in models and from starts with these weights, or without."""
    case, way = trial.case, WAYS[trial.case.way]
    run, seed = RunReader(case.run), seed_of(case)
    config = config_of(run, way, seed)
    data, arrays = buffer_at(run, case.step), _arrays(run, case.step)
    rows, (model,), policy = data.transitions, case.models, StoredPolicy(arrays)
    weighting = weighting_of(data, policy, config, way)
    # Weights of 1 rather than none: without any, starts are drawn with other random numbers.
    even = torch.ones(len(rows))
    starts = weighting.for_starts(config.rollout)
    starts = even if starts is None else starts
    sac, ends = _resumed(run, case.step, arrays), _ends(run, rows, config)

    def during(fit: DynamicsModel, weights: Tensor) -> float:
        return _return_during(sac(config), fit, ends, rows, weights, config, trial)

    weighted = fitted(model, rows, weighting, config)
    both = during(weighted, starts)
    in_model = in_starts = both
    if case.way != UNIFORM:
        plain = fitted(model, rows, Weighting(even), config)
        in_model, in_starts = during(weighted, even), during(plain, starts)
    return Improvement(
        recording=run.run_id,
        env=run.env,
        step=case.step,
        way=case.way,
        seed=case.seed,
        before=_evaluate(Evaluator(task(run.env), trial.episodes), policy.mean, seed),
        model=in_model,
        starts=in_starts,
        both=both,
    )


def _arrays(run: RunReader, step: int) -> Mapping[str, NDArray[Any]]:
    path = run.path / layout.policy(step)
    try:
        return read_arrays(path)
    except DAMAGE as error:
        raise UserError(f"{path} is no stored policy ({reason(error)}): name another run") from None


def _resumed(
    run: RunReader, step: int, arrays: Mapping[str, NDArray[Any]]
) -> Callable[[OnlineConfig], Sac]:
    """Makes the SAC that goes on from a stored policy, with the run's settings of SAC."""
    settings = SacConfig.model_validate(run.config["config"]["sac"])
    steps, values = curve_points(run.metrics(), TEMPERATURE)
    temperature = temperature_at(
        step,
        np.append(sac_begins(run), steps),
        np.append(settings.initial_temperature, values),
    )

    def make(config: OnlineConfig) -> Sac:
        return resumed_sac(arrays, settings, temperature, Streams(config.seed).torch("sac"))

    return make


def temperature_at(step: int, steps: NDArray[Any], values: NDArray[Any]) -> float:
    """SAC's temperature between two records of it (S,), which its optimiser moves in logarithms."""
    return float(np.exp(np.interp(step, steps, np.log(values))))


def _ends(run: RunReader, rows: TensorTransitions, config: OnlineConfig) -> Termination:
    """What ends a modelled episode."""
    known, named = task(run.env), rule_of(run)
    if not learns_ends(known, named):
        return rule(known, named)
    streams = Streams(config.seed)
    head = EndingHead(known.obs_dim, config.model, streams.torch("ends"))
    head.fit(rows, torch.ones(len(rows)), len(rows), streams.torch("fit ends"))
    return head


def _return_during(
    sac: Sac,
    model: DynamicsModel,
    ends: Termination,
    rows: TensorTransitions,
    weights: Tensor,
    config: OnlineConfig,
    trial: Trial,
) -> float:
    """Mean of `PARTS` evaluations during the updates on rollouts in the model (lines 21-25)."""
    streams, known = Streams(config.seed), task(config.env)
    dims, rollout = (known.obs_dim, known.action_dim), config.rollout
    replay = ReplayBuffer(len(rows), *dims)
    replay.extend(rows)
    modelled = ReplayBuffer(rollout.starts * rollout.length, *dims)
    generator, policy = streams.torch("rollout"), sac.policy
    starts = start_states(rows, weights, rollout.starts, generator)
    roll_out(model, policy, ends, starts, rollout.length, rollout, modelled, generator)
    evaluator, returns, generator = Evaluator(known, trial.episodes), [], streams.torch("batches")
    size, real = sac.config.batch_size, config.real_ratio
    for _ in range(PARTS):
        updates = trial.updates // PARTS
        batches = mixed_batches(replay, modelled, updates, size, real, generator)
        metrics = sac.updates(batches)
        if not all(bool(value.isfinite().all()) for value in metrics.values()):
            return float("nan")
        returns.append(_evaluate(evaluator, policy.mean, config.seed))
    return mean(returns)


def _evaluate(evaluator: Evaluator, mean_action: Callable[[Tensor], Tensor], seed: int) -> float:
    """Mean return of the mean policy; the same start states each time."""
    episodes = evaluator.run(mean_action, Streams(seed).integer("evaluation"))
    return mean(float(episode.reward.sum()) for episode in episodes)
