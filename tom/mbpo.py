"""Model-based policy optimisation with a learner's weights: Algorithm 2 of the paper.

The lines named below are those of its print in appendix B. As in the released code, rollouts (lines
21-23) are made once a fit and not at each step. Lines 3-14, the weights, are the learner's.

`Mbpo.events()` is a generator. Its consumers do the recording, progress display, checkpoints and
evaluation curves: this file uses no file, clock or socket.
"""

from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from tom.config import OnlineConfig
from tom.data.replay import ReplayBuffer
from tom.data.transitions import TensorTransitions
from tom.dynamics import FitReport, make_model
from tom.dynamics.ending import EndingHead
from tom.envs import Task, task
from tom.envs.environment import capture, restore, simulated
from tom.envs.termination import learns_ends, rule
from tom.events import Collected, Evaluation, Event, Metrics, Notice, Tick, TrainedPolicy
from tom.exams.diagnostics import errors_of_rows, fit_metrics
from tom.exams.exam import Exam, Fitted, critic_metrics, footprint_metrics, model_metrics
from tom.learners import make_learner
from tom.learners.base import FitContext, Weighting, heavy_row
from tom.metrics import require_finite
from tom.policy.collect import Evaluator
from tom.policy.rollout import mixed_batches, roll_out, start_states
from tom.policy.sac import Sac
from tom.policy.stored import policy_arrays
from tom.rng import Streams


class Mbpo:
    """One run: the policy, the model, the learner, the buffers and the state of the run."""

    def __init__(self, config: OnlineConfig) -> None:
        self.config = config
        self.task: Task = task(config.env)
        self.streams = Streams(config.seed, config.device)
        obs_dim, action_dim = self.task.obs_dim, self.task.action_dim
        generator = self.streams.torch
        self.sac = Sac(obs_dim, action_dim, config.sac, generator("sac"))
        self.policy = self.sac.policy
        self.model = make_model(obs_dim, action_dim, config.model, generator("model"))
        self.terminated = rule(self.task, config.model.termination)
        self.ending: EndingHead | None = None
        if learns_ends(self.task, config.model.termination):
            self.ending = EndingHead(obs_dim, config.model, generator("ends"))
            self.terminated = self.ending
        self.learner = make_learner(
            config.learner, config, obs_dim, action_dim, generator("learner")
        )
        dims, device = (obs_dim, action_dim), config.device
        self.replay = ReplayBuffer(  # D_env
            config.replay_capacity, *dims, device, keeps_behaviour=True
        )
        kept = config.rollout.kept_at(0, config.fit_every)
        self.model_buffer = ReplayBuffer(kept, *dims, device)  # D_model
        self.env = self.task.make()
        self._simulated = simulated(self.env) if self.task.keeps_states else None
        self._states: list[tuple[np.ndarray, np.ndarray]] = []  # (qpos, qvel) at uncollected rows
        self.evaluator = Evaluator(self.task, config.evaluation.episodes)
        self.env_step = 0
        self.policy_version = 1  # 0 is exploration
        self._fitted: Fitted | None = None  # the last fit, before its exam
        self._obs: np.ndarray | None = None
        self._initial_obs: list[np.ndarray] = []
        self._episode_return = 0.0
        self._episode_length = 0
        self._sac_metrics: dict[str, Tensor] = {}
        self._flushed = 0

    def events(self) -> Iterator[Event]:
        """Algorithm 2, from the current step to the last."""
        config = self.config
        while self.env_step < min(config.exploration_steps, config.steps):
            yield from self.step_environment(explore=True)
            yield Tick(self.env_step, "explore")
        while self.env_step < config.steps:
            if (self.env_step - config.exploration_steps) % config.fit_every == 0:
                yield from self.fit_and_roll_out()
            yield from self.step_environment(explore=False)
            self.optimise_policy()
            if self.env_step % config.evaluation.every == 0 or self.env_step == config.steps:
                yield from self.evaluate()
            yield Tick(self.env_step, "optimise")
        yield from self._flush_collected()
        yield from self.examine()
        yield TrainedPolicy(self.env_step, policy_arrays(config.env, self.sac))

    def fit_and_roll_out(self) -> Iterator[Event]:
        """Lines 3-18 and 21-23: weights, weighted model fit, rollouts from weighted states."""
        yield Tick(self.env_step, "fit")
        self._sac_losses()  # ends the run here if the policy has diverged
        yield from self._flush_collected()
        yield from self.examine()
        context = self._fit_context()
        weighting = self.learner.weigh(context)
        policy = policy_arrays(self.config.env, self.sac)
        yield weighting.event(self.env_step, policy)
        fit_weights = weighting.for_fit(self.config.model)
        report = self.model.fit(context.replay, *fit_weights, self.streams.torch("fit"))
        self._fitted = Fitted(self.env_step, weighting.counted(self.config.model))
        ends = self.fit_ends(context.replay, weighting)
        rollout_metrics = self.roll_out_model(context.replay, weighting)
        heavy = heavy_row(weighting.for_starts(self.config.rollout))
        for kind, message in (*weighting.notices, *heavy, *report.notices, *ends.notices):
            yield Notice(self.env_step, kind, message)
        diagnostics = fit_metrics(self.model, context, weighting, self.streams.torch("diagnostics"))
        measured = {**weighting.metrics, **report.metrics, **ends.metrics}
        yield Metrics(self.env_step, measured | rollout_metrics | diagnostics)

    def fit_ends(self, replay: TensorTransitions, weighting: Weighting) -> FitReport:
        """Fit the head that learns ends of episodes, if there is one."""
        if self.ending is None:
            return FitReport({})
        weights = weighting.counted(self.config.model)
        collected = self.replay.total_added
        return self.ending.fit(replay, weights, collected, self.streams.torch("ends"))

    def examine(self) -> Iterator[Event]:
        """The last fit's exam, on the steps since that fit, which are not in its buffer."""
        if self._fitted is None:
            return
        at, generator = self._fitted.env_step, self.streams.torch("exam")
        exam = Exam.of(self._fitted, self.replay.transitions(), self.env_step - at)
        temperature, discount = self.sac.log_temperature.exp(), self.config.sac.discount
        yield Metrics(
            at,
            {
                **footprint_metrics(exam, generator),
                **model_metrics(self.model, exam, self.terminated, generator),
                **critic_metrics(self.policy, exam.rows, temperature, discount, generator),
            },
        )

    def roll_out_model(self, replay: TensorTransitions, weighting: Weighting) -> dict[str, float]:
        """Lines 21-23: k-step rollouts from states drawn by weight, into D_model."""
        config, generator = self.config.rollout, self.streams.torch("rollout")
        self.model_buffer.resize(config.kept_at(self._on_policy_steps, self.config.fit_every))
        starts = start_states(replay, weighting.for_starts(config), config.starts, generator)
        return roll_out(
            self.model,
            self.policy,
            self.terminated,
            starts,
            config.length_at(self._on_policy_steps),
            config,
            self.model_buffer,
            generator,
        )

    def step_environment(self, explore: bool) -> Iterator[Event]:
        """Lines 20 and 26: one step of pi in the environment, into D_env, whose end is D_pol."""
        if self.replay.total_added - self._flushed == self.replay.capacity:
            yield from self._flush_collected()  # the next row replaces one that is not recorded
        obs = self._begin_episode() if self._obs is None else self._obs
        action, behaviour = (self._random_action(), None) if explore else self._policy_action(obs)
        if self._simulated is not None:
            data = self._simulated.data
            self._states.append((data.qpos.copy(), data.qvel.copy()))
        next_obs, reward, terminated, truncated, _ = self.env.step(action)
        version = 0 if explore else self.policy_version
        ends = terminated, truncated
        self.replay.add(obs, action, float(reward), next_obs, *ends, version, behaviour)
        self.env_step += 1
        self._episode_return += float(reward)
        self._episode_length += 1
        self._obs = next_obs
        if terminated or truncated:
            yield Metrics(
                self.env_step,
                {"train/return": self._episode_return, "train/length": float(self._episode_length)},
            )
            self._obs = None

    def optimise_policy(self) -> None:
        """Lines 24-25: G gradient steps of SAC on model and a few real transitions."""
        config = self.config
        batches = mixed_batches(
            self.replay,
            self.model_buffer,
            config.updates_per_step,
            config.sac.batch_size,
            config.real_ratio,
            self.streams.torch("batches"),
        )
        self._sac_metrics = self.sac.updates(batches)
        if self.streams.device.type == "cpu":  # on a GPU this check would force a wait
            self._sac_losses()
        self.policy_version += 1

    def evaluate(self) -> Iterator[Event]:
        """Episodes of the mean policy in separate environments."""
        yield Tick(self.env_step, "evaluate")
        yield Metrics(self.env_step, self._sac_losses())
        seed = self.streams.integer(f"evaluation {self.env_step}")
        yield Evaluation(self.env_step, self.evaluator.run(self.policy.mean, seed))

    # State

    def state_dict(self) -> dict[str, Any]:
        """The state that determines the rest of the run, after a step: tensors and primitives.

        Of the replay buffer it has only the rows since the last `Collected` event: the others have
        been recorded and are passed to `load_state_dict`. Raises DivergedError.
        """
        self._sac_losses()
        state = {
            "env_step": self.env_step,
            "policy_version": self.policy_version,
            "sac": self.sac.state_dict(),
            "model": self.model.state_dict(),
            "learner": self.learner.state_dict(),
            "streams": self.streams.state_dict(),
            "model_buffer": self.model_buffer.state_dict(),
            "collected": self._flushed,
            "uncollected": self.replay.tail(self.replay.total_added - self._flushed),
            "env": capture(self.env),
            "obs": None if self._obs is None else torch.from_numpy(self._obs),
            "initial_obs": torch.from_numpy(np.stack(self._initial_obs)),
            "episode": [self._episode_return, float(self._episode_length)],
            "sac_metrics": self._sac_metrics,
            "fitted": None if self._fitted is None else vars(self._fitted),
        }
        if self.ending is not None:
            state["ending"] = self.ending.state_dict()
        if self._states:
            state["states"] = [
                torch.from_numpy(np.stack(part)) for part in zip(*self._states, strict=True)
            ]
        return state

    def load_state_dict(self, state: dict[str, Any], collected: Collected) -> None:
        """Continue from `state_dict`; `collected` are all rows recorded before it, in order."""
        self.env_step, self.policy_version = state["env_step"], state["policy_version"]
        config = self.config
        self.model_buffer.resize(config.rollout.kept_at(self._on_policy_steps, config.fit_every))
        for part in ("sac", "model", "learner", "streams", "model_buffer"):
            getattr(self, part).load_state_dict(state[part])
        known = collected.behaviour
        self.replay.extend(
            collected.transitions.torch(),
            torch.from_numpy(collected.policy_version),
            None if known is None else torch.from_numpy(known),
        )
        self._flushed = state["collected"]
        self.replay.restore_tail(state["uncollected"])
        self.env.reset()  # a wrapper needs a reset before its counters can be restored
        restore(self.env, state["env"])
        self._obs = None if state["obs"] is None else state["obs"].numpy()
        self._initial_obs = list(state["initial_obs"].numpy())
        self._episode_return, length = state["episode"]
        self._episode_length = int(length)
        self._sac_metrics = state["sac_metrics"]
        if self.ending is not None:
            self.ending.load_state_dict(state["ending"])
        self._states = list(zip(*(part.numpy() for part in state.get("states", ())), strict=True))
        if fitted := state["fitted"]:
            weights = fitted["weights"].to(self.streams.device)
            self._fitted = Fitted(fitted["env_step"], weights)

    # Parts

    @property
    def policy_buffer(self) -> TensorTransitions:
        """D_pol: the last on-policy transitions, the newest rows of D_env."""
        return self.replay.last(min(self._on_policy_steps, self.config.policy_capacity))

    @property
    def _on_policy_steps(self) -> int:
        return max(self.env_step - self.config.exploration_steps, 0)

    def _sac_losses(self) -> dict[str, float]:
        """The metrics of the last SAC update, fetched in one transfer. Raises DivergedError."""
        if not self._sac_metrics:
            return {}
        values = torch.cat(list(self._sac_metrics.values())).tolist()
        losses = dict(zip(self._sac_metrics, values, strict=True))
        require_finite(losses, self.env_step)
        return losses

    def _begin_episode(self) -> np.ndarray:
        seed = self.streams.integer("env") if not self._initial_obs else None
        obs, _ = self.env.reset(seed=seed)
        self._initial_obs.append(np.asarray(obs, np.float32))
        self._episode_return, self._episode_length = 0.0, 0
        return obs

    def _random_action(self) -> np.ndarray:
        action = self.streams.numpy("explore").uniform(-1.0, 1.0, self.task.action_dim)
        return action.astype(np.float32)

    def _policy_action(self, obs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        seen = torch.as_tensor(obs, dtype=torch.float32).to(self.streams.device)
        return self.policy.act(seen, self.streams.torch("act"))

    def _fit_context(self) -> FitContext:
        replay = self.replay.transitions()
        return FitContext(
            replay=replay,
            policy_version=self.replay.policy_version(),
            behaviour=self.replay.behaviour(),
            policy_buffer=self.policy_buffer,
            on_policy_steps=self._on_policy_steps,
            initial_obs=torch.as_tensor(np.stack(self._initial_obs)).to(self.streams.device),
            policy=self.policy,
            generator=self.streams.torch("weigh"),
            value_gradient=self.policy.value_gradient,
            model_errors=partial(errors_of_rows, self.model, replay) if self._fitted else None,
        )

    def _flush_collected(self) -> Iterator[Event]:
        rows = self.replay.since(self._flushed)
        self._flushed = self.replay.total_added
        if len(rows):
            versions = self.replay.policy_version()[-len(rows) :].cpu().numpy().copy()
            parts = [np.stack(part) for part in zip(*self._states, strict=True)]
            self._states = []
            state: dict[str, np.ndarray] = dict(zip(("qpos", "qvel"), parts, strict=False))
            behaviour = self.replay.behaviour()[-len(rows) :].cpu().numpy().copy()
            yield Collected(self.env_step, rows.copy().numpy(), versions, state, behaviour)
