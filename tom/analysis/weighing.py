"""Any learner's weights for recorded data, as the policy of interest would have them.

The data may be a run's replay buffer or a dataset; the policy may come from a run or act at
random. The policy's footprint is made in the real environment.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from tom.analysis.ordered_data import OrderedData, find_run
from tom.config import RunConfig
from tom.envs import MujocoTask
from tom.errors import UserError, unknown
from tom.exams.energy import footprint_match, step_scaling
from tom.learners import FOLLOW_THE_VALUE, LEARNERS, make_learner
from tom.learners.base import FitContext
from tom.policy.collect import Footprint, footprint
from tom.policy.stored import NAME, StoredPolicy, UniformPolicy, read_policy
from tom.record import Store, layout
from tom.rng import Streams

RANDOM = "random"
PolicyOfInterest = StoredPolicy | UniformPolicy


@dataclass(frozen=True)
class Weighed:
    """One learner's weights (N,) under one seed, mean 1.

    `match` says how near the data so weighted is to fresh episodes of the policy
    (`tom.exams.energy`).
    """

    learner: str
    seed: int
    weights: NDArray[np.float32]
    log_ratio: NDArray[np.float32] | None
    metrics: dict[str, float]
    notices: tuple[tuple[str, str], ...]
    footprint_return: float | None  # mean return of the footprint's whole episodes
    match: dict[str, float] = field(default_factory=dict)

    def in_order(self, order: NDArray[np.int64]) -> "Weighed":
        """Back to the rows' own order, where row i of these weights is of row order[i]."""
        back = np.argsort(order)
        ratio = None if self.log_ratio is None else self.log_ratio[back]
        return replace(self, weights=self.weights[back], log_ratio=ratio)


def policy_env(name: str, store: Store) -> str | None:
    """The task that the policy `name` was trained for; None for the random one."""
    if name == RANDOM:
        return None
    run = find_run(name, store)
    return read_policy(Path(name)).env if run is None else run.env


def load_policy(
    name: str, store: Store, known: MujocoTask, step: int | None = None
) -> PolicyOfInterest:
    """`random`, a `policy.npz`, or a run (folder or id) that holds one. Raises UserError.

    `step` asks for the policy that a run had at the model fit of that env step.
    """
    if name == RANDOM:
        return UniformPolicy(known.obs_dim, known.action_dim)
    policy = _stored(name, store, step)
    dims = policy.obs_dim, policy.action_dim
    if dims != (known.obs_dim, known.action_dim):
        raise UserError(
            f"policy {name} maps {dims[0]} observations to {dims[1]} actions, {known.name} has "
            f"{known.obs_dim} and {known.action_dim}: name a policy of that task"
        )
    if policy.env != known.name:  # Walker2d's dimensions are HalfCheetah's
        raise UserError(
            f"policy {name} is of {policy.env}, not of {known.name}: name a policy of {known.name}"
        )
    return policy


def weigh(
    data: OrderedData,
    policy: PolicyOfInterest,
    known: MujocoTask,
    config: RunConfig,
    learners: Sequence[str],
    seeds: Sequence[int],
    footprint_rows: int = 1000,
) -> Iterator[Weighed]:
    """Every learner's weights under every seed, as they are found.

    A seed fixes the footprint (the policy's sampled actions in the real environment), all that a
    learner draws, and as many fresh transitions that judge the weights: no learner has seen them.
    Raises UserError for a learner that needs more than the policy has.
    """
    for name in learners:
        if name not in LEARNERS:
            raise unknown("learner", name, LEARNERS)
        if name in FOLLOW_THE_VALUE and policy.value_gradient is None:
            raise UserError(
                f"learner {name} follows a value function, and this policy comes without one: "
                f"leave {name} out, or name the policy of a newer run"
            )
    for seed in seeds:
        streams = Streams(seed)
        made, fresh = (
            footprint(
                known, policy, footprint_rows, streams.integer(f"{use} env"), streams.torch(use)
            )
            for use in ("footprint", "fresh episodes")
        )
        for name in learners:
            yield _weigh(data, policy, made, fresh, config.but(learner=name, seed=seed))


def _weigh(
    data: OrderedData,
    policy: PolicyOfInterest,
    made: Footprint,
    fresh: Footprint,
    config: RunConfig,
) -> Weighed:
    rows, streams = data.transitions, Streams(config.seed)
    dims = rows.obs.shape[1], rows.action.shape[1]
    learner = make_learner(config.learner, config, *dims, streams.torch("learner"))
    context = FitContext(
        replay=rows,
        policy_version=data.policy_version,
        policy_buffer=made.transitions.torch(),
        on_policy_steps=max(len(made.transitions), config.tom.warmup),
        initial_obs=data.initial_obs,
        policy=policy,
        generator=streams.torch("weigh"),
        value_gradient=policy.value_gradient,
    )
    found = learner.weigh(context)
    judges, generator = fresh.transitions.torch(), streams.torch("exam")
    match = footprint_match(rows, found.weights, judges, step_scaling(rows), generator)
    ratio = None if found.log_ratio is None else found.log_ratio.to(torch.float32).numpy()
    return Weighed(
        learner=config.learner,
        seed=config.seed,
        weights=found.weights.to(torch.float32).numpy(),
        log_ratio=ratio,
        metrics=dict(found.metrics),
        notices=tuple(found.notices),
        footprint_return=float(np.mean(made.returns)) if made.returns else None,
        match=match,
    )


def _stored(name: str, store: Store, step: int | None) -> StoredPolicy:
    run = find_run(name, store)
    if step is None:
        return read_policy(Path(name) if run is None else run.path / NAME)
    if run is None:
        raise UserError(f"--step {step} is a step of a run, and policy {name} is none: name a run")
    kept = run.policy_steps()
    if step not in kept:
        advice = "--step takes one of " + ", ".join(map(str, kept))
        if not kept:
            advice = "it kept none of its fits (nor did any run of an earlier version): omit --step"
        raise UserError(f"run {run.run_id} kept no policy of step {step}: {advice}")
    return read_policy(run.path / layout.policy(step))
