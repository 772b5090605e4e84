"""SAC alone, its whole replay kept in order: what the weights of an ordered buffer are judged on.

The first half of the rows is random, the second what SAC collected while it learnt (the paper's
analysis of importance weights, section 5.2). Like `Mbpo`, a generator of events.
"""

from collections.abc import Iterator

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tom.collect import Collector, Step, transitions_of
from tom.config import SacRecordingConfig
from tom.data.replay import ReplayBuffer
from tom.data.sampling import uniform_indices
from tom.envs import MujocoTask, task
from tom.evaluate import Evaluator
from tom.events import Collected, Evaluation, Event, Metrics, Tick, TrainedPolicy
from tom.policy_file import policy_arrays
from tom.rng import Streams
from tom.sac import Sac

HANDED_OVER = 1000  # steps between two hand-overs of collected rows


class SacRecording:
    """One recording: the random steps, then SAC in an environment of its own."""

    def __init__(self, config: SacRecordingConfig) -> None:
        self.config = config
        self.task: MujocoTask = task(config.env)
        self.streams = Streams(config.seed)
        dims = self.task.obs_dim, self.task.action_dim
        self.sac = Sac(*dims, config.sac, [self.streams.torch("sac")])
        self.policy = self.sac.member(0)
        self.replay = ReplayBuffer(config.steps, *dims)  # SAC never sees the random half
        self.evaluator = Evaluator(self.task, config.evaluation.episodes)
        self.env_step = 0
        self.policy_version = 0
        self._collected: list[tuple[Step, int]] = []
        self._sac_metrics: dict[str, Tensor] = {}

    def events(self) -> Iterator[Event]:
        """The whole recording, from its first random step to the trained policy."""
        yield from self.random_steps()
        yield from self.train()
        yield TrainedPolicy(self.env_step, policy_arrays(self.config.env, self.sac.actor))

    def random_steps(self) -> Iterator[Event]:
        """The first half: uniformly random actions."""
        collector = Collector(self.task, self.streams.integer("random env"))
        for _ in range(self.config.steps):
            self._add(collector.step(self._random_action()), version=0)
            yield from self._hand_over("explore")
        yield from self._flush()

    def train(self) -> Iterator[Event]:
        """The second half: SAC learns from its own steps while it takes them."""
        config = self.config
        collector = Collector(self.task, self.streams.integer("env"))
        for taken in range(1, config.steps + 1):
            explores = taken <= config.exploration_steps
            action = self._random_action() if explores else self._policy_action(collector.obs)
            step = collector.step(action)
            self._add(step, 0 if explores else self.policy_version)
            self.replay.add(*step[:6])
            if step.ended:
                yield Metrics(self.env_step, _episode(step))
            if taken >= config.exploration_steps:
                self.optimise()
            if taken % config.evaluation.every == 0 or taken == config.steps:
                yield from self.evaluate()
            yield from self._hand_over("optimise")
        yield from self._flush()

    def optimise(self) -> None:
        """Gradient steps on minibatches of SAC's own rows; a new policy version."""
        config = self.config
        for _ in range(config.updates_per_step):
            rows = uniform_indices(
                len(self.replay), config.sac.batch_size, self.streams.torch("batches")
            )
            self._sac_metrics = self.sac.update(self.replay.gather(rows)[None])
        self.policy_version += 1

    def evaluate(self) -> Iterator[Event]:
        """Episodes of the mean policy in environments of their own."""
        yield Tick(self.env_step, "evaluate")
        yield Metrics(self.env_step, {k: float(v[0]) for k, v in self._sac_metrics.items()})
        seed = self.streams.integer(f"evaluation {self.env_step}")
        yield Evaluation(self.env_step, self.evaluator.run(self.policy.mean, seed))

    # Parts

    def _random_action(self) -> NDArray[np.float32]:
        action = self.streams.numpy("explore").uniform(-1.0, 1.0, self.task.action_dim)
        return action.astype(np.float32)

    def _policy_action(self, obs: NDArray) -> NDArray[np.float32]:
        batch = torch.as_tensor(obs, dtype=torch.float32)[None]
        return self.policy(batch, 1, self.streams.torch("act"))[0, 0].numpy()

    def _add(self, step: Step, version: int) -> None:
        self._collected.append((step, version))
        self.env_step += 1

    def _hand_over(self, phase: str) -> Iterator[Event]:
        if self.env_step % HANDED_OVER == 0:
            yield from self._flush()
        yield Tick(self.env_step, phase)

    def _flush(self) -> Iterator[Event]:
        """The rows since the last time; an episode that its half breaks off is truncated."""
        if not self._collected:
            return
        steps, versions = zip(*self._collected, strict=True)
        self._collected = []
        state = {name: np.array([getattr(s, name) for s in steps]) for name in ("qpos", "qvel")}
        at_end = self.env_step in (self.config.steps, self.config.total_steps)
        rows = transitions_of(steps, cut=at_end)
        yield Collected(self.env_step, rows, np.array(versions, np.int64), state)


def _episode(step: Step) -> dict[str, float]:
    return {"train/return": step.episode_return, "train/length": float(step.episode_length)}
