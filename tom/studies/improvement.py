"""Does weighting make better policies? What one model does for the policy, moment by moment.

At a moment of a frozen buffer (`tom.studies.frozen`) soft actor-critic goes on from the stored
policy and critics, on rollouts in a model that was fitted to this buffer. A learner's weights act
in two places (Algorithm 2, lines 18 and 23): the fit of the model and the start states of its
rollouts. So every way of weighing acts in the model alone, in the starts alone, and in both, with
the same random numbers each time. Whole runs differ in data as well, and take hours.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import isfinite, nan
from statistics import mean, median
from typing import Any

import numpy as np
import torch
from torch import Tensor

from tom.analysis.curves import curve_points
from tom.config import OnlineConfig, SacConfig
from tom.data.replay import ReplayBuffer
from tom.data.transitions import TensorTransitions
from tom.data.unpack import read_arrays
from tom.dynamics import DynamicsModel
from tom.envs import task
from tom.envs.ends import rule
from tom.learners.base import Weighting
from tom.nn.lockstep import do
from tom.policy.evaluate import Evaluator
from tom.policy.rollout import roll_out, start_states
from tom.policy.sac import Sac
from tom.policy.sac_work import SacUpdates, mixed_batches
from tom.policy.stored import CRITIC, StoredPolicy, resumed_sac
from tom.record import RunReader, layout
from tom.rng import Streams
from tom.studies.footprint import UNIFORM
from tom.studies.frozen import WAYS, Case, buffer_at, config_of, fitted, weighting_of
from tom.studies.recordings import Value, over_recordings

PARTS = 5
"""evaluations of the policy, evenly spread over its updates"""
TEMPERATURE = "temperature/value"
PLACES = ("model", "starts", "both")
"""where the weights act"""


@dataclass(frozen=True)
class Trial:
    """A case with one model, the number of SAC updates, and the episodes of an evaluation."""

    case: Case
    updates: int = 2500
    episodes: int = 5


@dataclass(frozen=True)
class Improvement:
    """Mean-action returns: before the updates, and after them, mean over `PARTS` evaluations.

    `model`, `starts` and `both` say where the weights acted; with uniform weights all are equal.
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
    """Whether SAC can go on from the run's policies: those of earlier versions have no critics."""
    policies = (read_arrays(run.path / layout.policy(step)) for step in run.policy_steps())
    return all(f"{CRITIC}weight_0" in arrays for arrays in policies)


def improved(trial: Trial) -> Improvement:
    """Update the policy of a moment in models and from starts with these weights, or without."""
    case = trial.case
    run, way, path = RunReader(case.run), WAYS[case.way], case.run / layout.policy(case.step)
    data, arrays = buffer_at(run, case.step), read_arrays(path)
    policy, config = StoredPolicy(arrays), config_of(run, way, case.seed)
    rows, (model,) = data.transitions, case.models
    weighting = weighting_of(data, policy, config, newest=way.learner is None)
    fit = fitted(model, rows, weighting, config)
    sac_config = SacConfig.model_validate(run.config["config"]["sac"])
    temperature = _temperature(run, case.step, sac_config.initial_temperature)

    def after(weighted: DynamicsModel, starts: Tensor | None) -> float:
        generator = Streams(case.seed).torch("sac")
        sac = resumed_sac(arrays, sac_config, temperature, generator)
        return _return_after(sac, weighted, rows, starts, config, trial)

    both = after(fit, weighting.for_starts(config.rollout))
    alone = both, both
    if case.way != UNIFORM:
        plain = fitted(model, rows, Weighting(torch.ones(len(rows))), config)
        alone = after(fit, None), after(plain, weighting.for_starts(config.rollout))
    before = _evaluate(Evaluator(task(run.env), trial.episodes), policy.mean, case.seed)
    return Improvement(run.run_id, run.env, case.step, case.way, case.seed, before, *alone, both)


def _temperature(run: RunReader, step: int, initial: float) -> float:
    """SAC's temperature where it was recorded nearest to `step`."""
    steps, values = curve_points(run.metrics(), TEMPERATURE)
    return float(values[np.abs(steps - step).argmin()]) if len(steps) else initial


def _return_after(
    sac: Sac,
    model: DynamicsModel,
    rows: TensorTransitions,
    weights: Tensor | None,
    config: OnlineConfig,
    trial: Trial,
) -> float:
    """The mean of `PARTS` evaluations during the updates on rollouts in the model (lines 22-28)."""
    streams, known = Streams(config.seed), task(config.env)
    dims, rollout = (known.obs_dim, known.action_dim), config.rollout
    replay = ReplayBuffer(len(rows), *dims)
    replay.extend(rows)
    modelled = ReplayBuffer(rollout.starts * rollout.length, *dims)
    generator, policy = streams.torch("rollout"), sac.member(0)
    starts = start_states(rows, weights, rollout.starts, generator)
    terminated = rule(known, config.model.termination)
    roll_out(model, policy, terminated, starts, rollout.length, rollout, modelled, generator)
    evaluator, returns = Evaluator(known, trial.episodes), []
    for _ in range(PARTS):
        batches = mixed_batches(
            replay,
            modelled,
            trial.updates // PARTS,
            sac.config.batch_size,
            config.real_ratio,
            streams.torch("batches"),
        )
        do(SacUpdates(sac, batches))
        returns.append(_evaluate(evaluator, policy.mean, config.seed))
    return mean(returns)


def _evaluate(evaluator: Evaluator, mean_action: Callable[[Tensor], Tensor], seed: int) -> float:
    """Mean return of the mean policy; the same start states each time."""
    episodes = evaluator.run(mean_action, Streams(seed).integer("evaluation"))
    return mean(float(episode.reward.sum()) for episode in episodes)


# What came of it


def gain(value: float, base: float) -> float:
    """2 (value - base) / (|value| + |base|): .1 is about a tenth more; in [-2, 2], 0 for 0."""
    size = abs(value) + abs(base)
    return 2 * (value - base) / size if size else 0.0


def gains(found: Sequence[Improvement], way: str, place: str) -> list[Value]:
    """The gain over uniform weights at every moment that was tried with both."""
    base = {_moment(one): one.both for one in found if one.way == UNIFORM}
    values = [
        (one.env, one.recording, gain(getattr(one, place), base.get(_moment(one), nan)))
        for one in found
        if one.way == way
    ]
    return [value for value in values if isfinite(value[2])]


def own_gains(found: Sequence[Improvement]) -> list[Value]:
    """The gain of the updates under uniform weights over the policy before them."""
    return [(o.env, o.recording, gain(o.both, o.before)) for o in found if o.way == UNIFORM]


def summary(found: Sequence[Improvement]) -> list[dict[str, Any]]:
    """One row for uniform weights, and one for each other way and each place where they act."""
    rows = [_row(UNIFORM, "over the policy before", own_gains(found))]
    for way in dict.fromkeys(one.way for one in found if one.way != UNIFORM):
        rows += [_row(way, place, gains(found, way, place)) for place in PLACES]
    return [row for row in rows if row["n"]]


def _row(way: str, weights: str, values: Sequence[Value]) -> dict[str, Any]:
    row: dict[str, Any] = {"way": way, "weights in": weights}
    if values:
        score = over_recordings(values)
        row |= {"gain": score.value, "low": score.low, "high": score.high}
        for env in dict.fromkeys(env for env, _, _ in values):
            row[env] = median(value for of, _, value in values if of == env)
    better = sum(value > 0 for _, _, value in values)
    return row | {"better at": better, "n": len(values)}


def verdict(found: Sequence[Improvement]) -> list[str]:
    """The table in words: each way against uniform weights, and whether its interval leaves 0."""
    first, *rows = summary(found)
    moments = {_moment(one) for one in found}
    said = [
        f"{len(moments)} moments of {len({one.recording for one in found})} runs in "
        f"{len({one.env for one in found})} tasks. Updates in the model without weights change "
        f"the policy's return by {_words(first)}."
    ]
    for row in rows:
        where = "both" if row["weights in"] == "both" else f"the {row['weights in']} alone"
        said.append(f"{row['way']}, weights in {where}: {_words(row)}. {_beyond(row)}")
    return said


def _words(row: dict[str, Any]) -> str:
    bounds = f" [{row['low']:+.2f}, {row['high']:+.2f}]" if isfinite(row["low"]) else ""
    return f"{row['gain']:+.2f}{bounds}, better at {row['better at']} of {row['n']}"


def _beyond(row: dict[str, Any]) -> str:
    if not isfinite(row["low"]):
        return "One recording a task: no interval."
    if row["low"] > 0:
        return "A gain beyond the interval."
    return "A loss beyond the interval." if row["high"] < 0 else "No difference beyond it."


def _moment(one: Improvement) -> tuple[str, int, int]:
    return one.recording, one.step, one.seed
