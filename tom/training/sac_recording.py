"""SAC alone, with its whole replay buffer in order, for studies of weights of an ordered buffer.

The first half of the rows is random; SAC collects the second half while it learns (the paper's
analysis of importance weights, section 5.2). Like `Mbpo`, it is a generator of events.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tom.config import SacRecordingConfig
from tom.data.replay import ReplayBuffer
from tom.data.sampling import uniform_indices
from tom.envs import Task, task
from tom.events import (
    Collected,
    Evaluation,
    Event,
    KeptPolicy,
    Metrics,
    Tick,
    TrainedPolicy,
)
from tom.metrics import require_finite
from tom.policy.collect import Collector, Evaluator, Step, transitions_of
from tom.policy.sac import Sac
from tom.policy.stored import policy_arrays
from tom.rng import Streams

HANDED_OVER = 1000  # steps between two events of collected rows


class SacRecording:
    """One recording: the random steps, then SAC in a separate environment."""

    def __init__(self, config: SacRecordingConfig) -> None:
        self.config = config
        self.task: Task = task(config.env)
        self.streams = Streams(config.seed)
        dims = self.task.obs_dim, self.task.action_dim
        self.sac = Sac(*dims, config.sac, self.streams.torch("sac"))
        self.policy = self.sac.policy
        self.replay = ReplayBuffer(config.steps, *dims)  # SAC never sees the random half
        self.evaluator = Evaluator(self.task, config.evaluation.episodes)
        self.env_step = 0
        self.policy_version = 0
        self._unknown = np.full(2 * self.task.action_dim, np.nan, np.float32)
        self._collector = Collector(self.task, self.streams.integer("random env"))
        self._collected: list[tuple[Step, int, NDArray]] = []
        self._sac_metrics: dict[str, Tensor] = {}

    def events(self) -> Iterator[Event]:
        """The recording, from the current step to the trained policy."""
        config = self.config
        while self.env_step < config.steps:
            self._add(self._collector.step(self._random_action()), 0, self._unknown)
            yield from self._hand_over("explore")
        if self.env_step == config.steps:
            yield from self._flush()
            self._collector = Collector(self.task, self.streams.integer("env"))
        while self.env_step < config.total_steps:
            yield from self.learn()
            yield from self._hand_over("optimise")
        yield from self._flush()
        yield TrainedPolicy(self.env_step, policy_arrays(config.env, self.sac))

    def learn(self) -> Iterator[Event]:
        """One step of the second half, in which SAC learns from its own steps."""
        config = self.config
        taken = self.env_step - config.steps + 1
        explores = taken <= config.exploration_steps
        if explores:
            action, behaviour, version = self._random_action(), self._unknown, 0
        else:
            obs = torch.as_tensor(self._collector.obs, dtype=torch.float32)
            action, behaviour = self.policy.act(obs, self.streams.torch("act"))
            version = self.policy_version
        step = self._collector.step(action)
        self._add(step, version, behaviour)
        self.replay.add(*step[:6])
        if step.ended:
            length = float(step.episode_length)
            values = {"train/return": step.episode_return, "train/length": length}
            yield Metrics(self.env_step, values)
        if taken >= config.exploration_steps:
            self.optimise()
        if config.snapshots and taken % max(config.steps // config.snapshots, 1) == 0:
            yield KeptPolicy(self.env_step, policy_arrays(config.env, self.sac))
        if taken % config.evaluation.every == 0 or taken == config.steps:
            yield from self.evaluate()

    def optimise(self) -> None:
        """Gradient steps on minibatches of SAC's own rows, then a new policy version."""
        config = self.config
        for _ in range(config.updates_per_step):
            rows = uniform_indices(
                len(self.replay), config.sac.batch_size, self.streams.torch("batches")
            )
            self._sac_metrics = self.sac.update(self.replay.gather(rows))
        require_finite(self._sac_metrics, self.env_step)
        self.policy_version += 1

    def evaluate(self) -> Iterator[Event]:
        yield Tick(self.env_step, "evaluate")
        yield Metrics(self.env_step, {k: float(v[0]) for k, v in self._sac_metrics.items()})
        seed = self.streams.integer(f"evaluation {self.env_step}")
        yield Evaluation(self.env_step, self.evaluator.run(self.policy.mean, seed))

    # State

    def state_dict(self) -> dict[str, Any]:
        """The state that determines the rest of the recording, without the recorded rows."""
        return {
            "env_step": self.env_step,
            "policy_version": self.policy_version,
            "sac": self.sac.state_dict(),
            "streams": self.streams.state_dict(),
            "collector": self._collector.state_dict(),
            "collected": self.env_step - len(self._collected),
            "uncollected": [
                (_plain(step), version, torch.from_numpy(behaviour))
                for step, version, behaviour in self._collected
            ],
            "sac_metrics": self._sac_metrics,
        }

    def load_state_dict(self, state: dict[str, Any], collected: Collected) -> None:
        """Continue from `state_dict`; `collected` are all rows recorded before it, in order."""
        self.env_step, self.policy_version = state["env_step"], state["policy_version"]
        self.sac.load_state_dict(state["sac"])
        self.streams.load_state_dict(state["streams"])
        self._collector.load_state_dict(state["collector"])
        self._collected = [
            (_step(parts), version, behaviour.numpy())
            for parts, version, behaviour in state["uncollected"]
        ]
        self._sac_metrics = state["sac_metrics"]
        self.replay.extend(collected.transitions[self.config.steps :].torch())
        first = state["collected"]
        for number, (step, *_) in enumerate(self._collected, start=first):
            if number >= self.config.steps:
                self.replay.add(*step[:6])

    # Parts

    def _random_action(self) -> NDArray[np.float32]:
        action = self.streams.numpy("explore").uniform(-1.0, 1.0, self.task.action_dim)
        return action.astype(np.float32)

    def _add(self, step: Step, version: int, behaviour: NDArray) -> None:
        self._collected.append((step, version, behaviour))
        self.env_step += 1

    def _hand_over(self, phase: str) -> Iterator[Event]:
        if self.env_step % HANDED_OVER == 0:
            yield from self._flush()
        yield Tick(self.env_step, phase)

    def _flush(self) -> Iterator[Event]:
        """The rows since the last call; an episode cut by the end of its half is truncated."""
        if not self._collected:
            return
        steps, versions, behaviour = zip(*self._collected, strict=True)
        self._collected = []
        state = {name: np.array([getattr(s, name) for s in steps]) for name in ("qpos", "qvel")}
        state = {name: values for name, values in state.items() if values.size}
        at_end = self.env_step in (self.config.steps, self.config.total_steps)
        rows = transitions_of(steps, cut=at_end)
        versions = np.array(versions, np.int64)
        yield Collected(self.env_step, rows, versions, state, np.stack(behaviour))


def _plain(step: Step) -> list[Any]:
    unwrapped = (x.item() if isinstance(x, np.generic) else x for x in step)
    return [torch.from_numpy(x) if isinstance(x, np.ndarray) else x for x in unwrapped]


def _step(parts: list[Any]) -> Step:
    arrays: list[Any] = [x.numpy() if isinstance(x, Tensor) else x for x in parts]
    return Step(*arrays)
