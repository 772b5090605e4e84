"""Any learner's weights for recorded data, given a policy of interest.

The data may be a run's replay buffer or a dataset. The policy may come from a run, act at random or
come from another library. The policy's footprint is collected in the real environment.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from tom.analysis.ordered_data import OrderedData, action_bounds, find_run
from tom.config import RunConfig
from tom.envs import GymnasiumTask, Task
from tom.errors import UserError, unknown
from tom.exams.energy import footprint_match, step_scaling
from tom.learners import LEARNERS, follows_value, make_learner
from tom.learners.base import FitContext
from tom.policy.collect import Footprint, footprint
from tom.policy.foreign import ForeignPolicy, foreign_policy, is_foreign
from tom.policy.stored import NAME, StoredPolicy, UniformPolicy, read_policy
from tom.record import RunReader, Store, layout
from tom.rng import Streams

RANDOM = "random"
PolicyOfInterest = StoredPolicy | UniformPolicy | ForeignPolicy
POLICIES = (
    "a run (id or folder), its policy.npz, a TorchScript (.pt) or ONNX file, a function "
    f"module:name, or {RANDOM}"
)


@dataclass(frozen=True)
class Weighed:
    """One learner's weights (N,) under one seed, mean 1.

    `match` is the distance of the weighted data to fresh episodes of the policy
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
    terms: dict[str, NDArray[np.float32]] = field(default_factory=dict)
    """the other terms of each weight (`tom.learners.terms`), if it comes from a dual Q"""

    def in_order(self, order: NDArray[np.int64]) -> "Weighed":
        """Undo a permutation: row i of these weights belongs to row order[i]."""
        back = np.argsort(order)
        ratio = None if self.log_ratio is None else self.log_ratio[back]
        terms = {name: term[back] for name, term in self.terms.items()}
        return replace(self, weights=self.weights[back], log_ratio=ratio, terms=terms)


def policy_env(name: str, store: Store) -> str | None:
    """The task that the policy `name` was trained for; None if it is not recorded."""
    if name == RANDOM or is_foreign(name):
        return None
    run = find_run(name, store)
    return read_policy(Path(name)).env if run is None else run.env


def load_policy(name: str, store: Store, known: Task, step: int | None = None) -> PolicyOfInterest:
    """The policy `name`, which is one of POLICIES. Raises UserError.

    `step` selects the policy that a run had at the model fit of that env step.
    """
    if name == RANDOM:
        return UniformPolicy(known.obs_dim, known.action_dim)
    if is_foreign(name):
        _no_step(name, step)
        # A task may scale its observations by their bounds.
        own_obs = known.own_obs if isinstance(known, GymnasiumTask) else np.asarray
        return foreign_policy(name, known.obs_dim, action_bounds(known), own_obs)
    policy = _stored(name, store, step)
    dims = policy.obs_dim, policy.action_dim
    if dims != (known.obs_dim, known.action_dim):
        raise UserError(
            f"policy {name} maps {dims[0]} observations to {dims[1]} actions, {known.name} has "
            f"{known.obs_dim} and {known.action_dim}: name a policy of that task"
        )
    if policy.env != known.name:  # dimensions alone do not tell Walker2d from HalfCheetah
        raise UserError(
            f"policy {name} is of {policy.env}, not of {known.name}: name a policy of {known.name}"
        )
    return policy


def weigh(
    data: OrderedData,
    policy: PolicyOfInterest,
    known: Task,
    config: RunConfig,
    learners: Sequence[str],
    seeds: Sequence[int],
    footprint_rows: int = 1000,
    stepped: Callable[[], None] = lambda: None,
) -> Iterator[Weighed]:
    """Compute every learner's weights under every seed and yield each when it is ready.

    A seed fixes the footprint (the policy's sampled actions in the real environment), a learner's
    random draws, and equally many fresh transitions that no learner has seen, which test the
    weights. `stepped` is called after each step in the real environment, 2 `footprint_rows` times
    per seed. Raises UserError if a learner needs something that the policy lacks.
    """
    for name in learners:
        if name not in LEARNERS:
            raise unknown("learner", name, LEARNERS)
        if follows_value(name) and policy.value_gradient is None:
            raise UserError(
                f"learner {name} follows a value function, and this policy comes without one: "
                f"leave {name} out, or name the policy of a newer run"
            )
    for seed in seeds:
        made, fresh = (
            made_anew(known, policy, footprint_rows, seed, use, stepped)
            for use in ("footprint", "fresh episodes")
        )
        for name in learners:
            yield _weigh(data, policy, made, fresh, config.but(learner=name, seed=seed))


def made_anew(
    known: Task,
    policy: PolicyOfInterest,
    rows: int,
    seed: int,
    use: str = "footprint",
    stepped: Callable[[], None] = lambda: None,
) -> Footprint:
    """Transitions of the policy in the real environment, reproducible for each seed and `use`."""
    streams = Streams(seed)
    start, draws = streams.integer(f"{use} env"), streams.torch(use)
    return footprint(known, policy, rows, start, draws, stepped)


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
    weighting = learner.weigh(context)
    judges, generator = fresh.transitions.torch(), streams.torch("exam")
    match = footprint_match(rows, weighting.weights, judges, step_scaling(rows), generator)
    ratio = None if weighting.log_ratio is None else weighting.log_ratio.to(torch.float32).numpy()
    terms = {} if weighting.terms is None else weighting.terms.recorded()
    return Weighed(
        learner=config.learner,
        seed=config.seed,
        weights=weighting.weights.to(torch.float32).numpy(),
        log_ratio=ratio,
        metrics=dict(weighting.metrics),
        notices=tuple(weighting.notices),
        footprint_return=float(np.mean(made.returns)) if made.returns else None,
        match=match,
        terms={name: term.to(torch.float32).numpy() for name, term in terms.items()},
    )


def _stored(name: str, store: Store, step: int | None) -> StoredPolicy:
    run = find_run(name, store)
    if run is None:
        _no_step(name, step)
        return read_policy(Path(name))
    if run.has_policy(step):
        return read_policy(run.path / (NAME if step is None else layout.policy(step)))
    of = "its end" if step is None else f"step {step}"
    raise UserError(f"run {run.run_id} kept no policy of {of}: {_advice(run, step)}")


def _advice(run: RunReader, step: int | None) -> str:
    """What to do where a run has no policy of `step` (None: of its end)."""
    if run.fits_model and (kept := run.policy_steps()):
        return "--step takes one of " + ", ".join(map(str, kept))
    if step is not None and run.has_policy():
        return "it kept none of its fits (nor did any run of an earlier version): omit --step"
    if run.status.state == "finished":
        return "name another run"
    return "train it to its end, or name another run"


def _no_step(name: str, step: int | None) -> None:
    if step is not None:
        raise UserError(f"--step {step} is a step of a run, and policy {name} is none: name a run")
