"""Any learner's weights for recorded data, as the policy of interest would have them.

The data may be a run's replay buffer or a dataset; the policy may come from a run or act at
random. The policy's footprint is made in the real environment.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from gymnasium.spaces import Box
from numpy.typing import NDArray
from torch import Tensor

from tom.collect import Footprint, footprint
from tom.config import RunConfig
from tom.data.datasets import initial_obs, read_dataset
from tom.data.transitions import TensorTransitions, Transitions
from tom.envs import MujocoTask, task
from tom.errors import UserError, unknown
from tom.learners import LEARNER_NAMES, make_learner
from tom.learners.base import FitContext, Policy
from tom.policy_file import NAME, StoredPolicy, UniformPolicy, read_policy
from tom.record import RunReader, Store
from tom.rng import Streams

RANDOM = "random"
FOLLOW_THE_VALUE = ("vagram", "vagram-ensemble")
WEIGHERS = tuple(name for name in LEARNER_NAMES if name not in FOLLOW_THE_VALUE)
"""Learners that need no value function: a stored policy has none."""


@dataclass(frozen=True)
class OrderedData:
    """N transitions in the order of collection, actions in [-1, 1]; random ones come first.

    `policy_version` (N,) says which policy collected each row; where that is not known every row
    has its own, as with SAC, which changes after every step. `initial_obs` (M0, O) are the
    episodes' starts.
    """

    name: str
    env: str | None
    transitions: TensorTransitions
    policy_version: Tensor
    initial_obs: Tensor
    ordered_from: int  # rows before it are random data

    def __len__(self) -> int:
        return len(self.transitions)

    def in_order(self, order: NDArray[np.int64]) -> "OrderedData":
        """The rows stored in another order, (N,) row numbers. Versions follow the storage."""
        return replace(self, transitions=self.transitions[torch.from_numpy(order)])


@dataclass(frozen=True)
class Weighed:
    """One learner's weights (N,) under one seed, mean 1."""

    learner: str
    seed: int
    weights: NDArray[np.float32]
    log_ratio: NDArray[np.float32] | None
    metrics: dict[str, float]
    notices: tuple[tuple[str, str], ...]
    footprint_return: float | None  # mean return of the footprint's whole episodes

    def in_order(self, order: NDArray[np.int64]) -> "Weighed":
        """Back to the rows' own order, where row i of these weights is of row order[i]."""
        back = np.argsort(order)
        ratio = None if self.log_ratio is None else self.log_ratio[back]
        return replace(self, weights=self.weights[back], log_ratio=ratio)


def load_data(name: str, store: Store, env: str | None = None) -> OrderedData:
    """A run of the store, a run folder, a D4RL file or a Minari folder.

    `env` names the task that a dataset was recorded in: its actions are in the task's own units.
    Raises UserError.
    """
    run = _run(name, store)
    if run is not None:
        return of_run(run)
    if not Path(name).exists():
        raise UserError(
            f"no data '{name}': name a run of {store.path}/, a run folder, a D4RL file (.hdf5) "
            "or a Minari folder"
        )
    if env is None:
        raise UserError(f"{name} does not say which task it is of: add --env")
    known = task(env)
    rows = read_dataset(name)
    _check_dims(name, rows, known)
    rows = replace(rows, action=to_unit_range(np.asarray(rows.action), known))
    return OrderedData(
        name=Path(name).stem,
        env=env,
        transitions=rows.torch(),
        policy_version=torch.arange(len(rows)),
        initial_obs=torch.as_tensor(initial_obs(rows)),
        ordered_from=0,
    )


def of_run(run: RunReader) -> OrderedData:
    """A run's replay buffer. Raises UserError when it has none."""
    env = task(run.env).name  # road-and-rocks has no policy that could be played here
    rows, version = run.buffer()
    if run.problems or not len(rows):
        lacking = "buffer" in run.left_out
        nothing = "left out of this small copy" if lacking else "it collected nothing"
        reason = "; ".join(run.problems) or nothing
        raise UserError(f"the replay buffer of run {run.run_id} cannot be used: {reason}")
    _check_dims(run.run_id, rows, task(env))
    settings = run.config.get("config", {})
    random_rows = settings.get("steps" if run.learner == "sac" else "exploration_steps", 0)
    return OrderedData(
        name=run.run_id,
        env=env,
        transitions=rows.torch(),
        policy_version=torch.from_numpy(version),
        initial_obs=torch.as_tensor(initial_obs(rows)),
        ordered_from=min(int(random_rows), len(rows) - 1),
    )


def after_random(random: OrderedData, ordered: OrderedData) -> OrderedData:
    """As many random rows as `ordered` has, then `ordered`: the paper's two halves.

    Raises UserError when `random` holds fewer.
    """
    n = len(ordered)
    if len(random) < n:
        raise UserError(f"{random.name} holds {len(random)} rows, {ordered.name} needs {n} of them")
    rows = TensorTransitions.join([random.transitions[:n], ordered.transitions])
    rows.truncated[n - 1] = 1 - rows.terminated[n - 1]
    version = ordered.policy_version - ordered.policy_version.min() + 1
    return OrderedData(
        name=f"{random.name}+{ordered.name}",
        env=ordered.env,
        transitions=rows,
        policy_version=torch.cat((torch.zeros(n, dtype=version.dtype), version)),
        initial_obs=torch.as_tensor(initial_obs(rows)),
        ordered_from=n,
    )


def to_unit_range(action: NDArray, known: MujocoTask) -> NDArray[np.float32]:
    """Actions (N, A) in the task's own control range, rescaled to [-1, 1]."""
    space = known.make().unwrapped.action_space
    assert isinstance(space, Box)
    return ((2 * action - (space.high + space.low)) / (space.high - space.low)).astype(np.float32)


def policy_env(name: str, store: Store) -> str | None:
    """The task that the policy `name` was trained for; None for the random one."""
    return None if name == RANDOM else _stored(name, store).env


def load_policy(name: str, store: Store, known: MujocoTask) -> Policy:
    """`random`, a `policy.npz`, or a run (folder or id) that holds one. Raises UserError."""
    if name == RANDOM:
        return UniformPolicy(known.obs_dim, known.action_dim)
    policy = _stored(name, store)
    dims = policy.obs_dim, policy.action_dim
    if dims != (known.obs_dim, known.action_dim):
        raise UserError(
            f"policy {name} maps {dims[0]} observations to {dims[1]} actions, {known.name} has "
            f"{known.obs_dim} and {known.action_dim}: name a policy of that task"
        )
    return policy


def weigh(
    data: OrderedData,
    policy: Policy,
    known: MujocoTask,
    config: RunConfig,
    learners: Sequence[str],
    seeds: Sequence[int],
    footprint_rows: int = 1000,
) -> Iterator[Weighed]:
    """Every learner's weights under every seed, as they are found.

    A seed fixes the footprint (the policy's sampled actions in the real environment) and all that
    a learner draws. Raises UserError for a learner that cannot weigh by a policy alone.
    """
    for name in learners:
        if name not in WEIGHERS:
            raise unknown("learner", name, WEIGHERS)
    for seed in seeds:
        streams = Streams(seed)
        start = streams.integer("footprint env")
        made = footprint(known, policy, footprint_rows, start, streams.torch("footprint"))
        for name in learners:
            yield _weigh(data, policy, made, config.but(learner=name, seed=seed))


def _weigh(data: OrderedData, policy: Policy, made: Footprint, config: RunConfig) -> Weighed:
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
    )
    found = learner.weigh(context)
    ratio = None if found.log_ratio is None else found.log_ratio.to(torch.float32).numpy()
    return Weighed(
        learner=config.learner,
        seed=config.seed,
        weights=found.weights.to(torch.float32).numpy(),
        log_ratio=ratio,
        metrics=dict(found.metrics),
        notices=tuple(found.notices),
        footprint_return=float(np.mean(made.returns)) if made.returns else None,
    )


def _run(name: str, store: Store) -> RunReader | None:
    path = Path(name)
    if (path / "config.json").is_file():
        return Store(path.absolute().parent).run(path.absolute().name)
    inside = "/" not in name and (store.path / name / "config.json").is_file()
    return store.run(name) if inside else None


def _stored(name: str, store: Store) -> StoredPolicy:
    run = _run(name, store)
    return read_policy(Path(name) if run is None else run.path / NAME)


def _check_dims(name: str, rows: Transitions, known: MujocoTask) -> None:
    dims = rows.obs.shape[1], rows.action.shape[1]
    if dims != (known.obs_dim, known.action_dim):
        raise UserError(
            f"{name} has {dims[0]} observations and {dims[1]} actions, {known.name} has "
            f"{known.obs_dim} and {known.action_dim}: is it data of another task or version?"
        )
