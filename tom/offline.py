"""Offline model-based RL on road-and-rocks (paper, section 5.1): data, weights, model, policy.

The learner weighs pre-recorded data, a linear model is fitted with those weights, and SAC is
trained only on rollouts in the model. `Offline.events()` is a generator; its consumers handle
files, clocks and sockets.
"""

from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor

from tom.config import RoadConfig
from tom.data.replay import ReplayBuffer
from tom.data.sampling import uniform_indices
from tom.events import Collected, Evaluation, Event, Field, Metrics, Notice, Tick
from tom.exams.diagnostics import errors_of_rows
from tom.learners import follows_value, make_learner
from tom.learners.base import FitContext, Weighting, uniform
from tom.learners.terms import of_recorded
from tom.metrics import require_finite
from tom.policy.foreign import clone
from tom.policy.rollout import roll_out, start_states
from tom.rng import Streams
from tom.road import offline_data, task
from tom.road.agent import RoadModel, RoadSac, fit_linear
from tom.road.baselines import BASELINES
from tom.road.measure import (
    held_out,
    map_field,
    model_errors,
    model_field,
    plan,
    reference_returns,
    returns,
    trajectory_field,
    weight_shares,
)

START_DRAWS = 1000
"""draws of the start distribution mu_0 for the dual"""


class Offline:
    """One run: the data, the learner, the model, the policy."""

    def __init__(self, config: RoadConfig) -> None:
        self.config = config
        self.streams = Streams(config.seed)
        self.data = offline_data.collect(config, self.streams)
        self.test = held_out(self.data.road_map, self.streams.torch("held out"))
        self.policy = RoadSac(config.sac, self.streams.torch("sac"))
        self.env_step = 0
        rollout = config.rollout
        longest = max(rollout.length, rollout.final_length)
        self.model_buffer = ReplayBuffer(
            rollout.starts * rollout.retain * longest, task.OBS_DIM, task.ACTION_DIM
        )
        self._sac_metrics: dict[str, Tensor] = {}

    def events(self) -> Iterator[Event]:
        """The run, from the current step to the last."""
        config = self.config
        if self.env_step == 0:
            yield from self.begin()
        while self.env_step < config.steps:
            if self.env_step % config.rollout_every == 0:
                yield Metrics(self.env_step, self.roll_out_model())
            self.optimise_policy()
            self.env_step += 1
            yield from self.report_if_due()
            yield Tick(self.env_step, "optimise")

    def report_if_due(self) -> Iterator[Event]:
        """Evaluation, weights and model if they are due, and always at the last step.

        If it was not due at the last step, it does not change the state. So a run that gets more
        steps later equals one that had them from the beginning.
        """
        config = self.config
        fit_due = self.env_step % config.fit_every == 0
        evaluated = fit_due or self.env_step % config.evaluation.every == 0
        if evaluated:
            yield from self.evaluate()
        if fit_due:
            yield from self.refit_and_record()
        elif self.env_step == config.steps:
            streams, weighting, model = self.streams.state_dict(), self.weighting, self.model
            if not evaluated:
                yield from self.evaluate()
            yield from self.refit_and_record()
            self.streams.load_state_dict(streams)
            self.weighting, self.model = weighting, model

    def refit_and_record(self) -> Iterator[Event]:
        """The record, after a new fit if the weights change with the value function."""
        if follows_value(self.config.learner):
            yield from self.fit(value_gradient=True)
        yield from self.record()

    def begin(self) -> Iterator[Event]:
        """The data, the first weighted fit and the evaluation of its model, before SAC starts."""
        yield from self.show_data()
        yield Tick(0, "fit")
        yield from self.fit(value_gradient=False)
        yield from self.evaluate()
        yield from self.drive_plan()
        yield from self.record()

    def show_data(self) -> Iterator[Event]:
        """The map and the recorded transitions."""
        data = self.data
        yield Field(0, "map", map_field(data.road_map))
        marks = {"expert": data.expert.numpy(), "footprint": data.footprint.numpy()}
        yield Field(0, "data", marks)
        yield Collected(0, data.rows.numpy(), storage_order(len(data.rows)).numpy())
        yield Metrics(0, reference_returns(data.road_map, self.streams.torch("references")))

    def fit(self, value_gradient: bool) -> Iterator[Event]:
        """Weigh the data, then fit the linear model with those weights."""
        self.weighting = self.weigh(self.context(value_gradient))
        self.model = fit_linear(self.data.rows, self.weighting)
        for kind, message in self.weighting.notices:
            yield Notice(self.env_step, kind, message)
        yield Metrics(
            self.env_step,
            {
                **self.weighting.metrics,
                **weight_shares(self.data, self.weighting.weights),
                **model_errors(self.model, self.test),
            },
        )

    def weigh(self, context: FitContext) -> Weighting:
        """The weights of the transitions, by the learner or baseline of that name."""
        config = self.config
        if config.learner in BASELINES:
            return BASELINES[config.learner](self.data, context, config.tom)
        learner = make_learner(
            config.learner, config, task.OBS_DIM, task.ACTION_DIM, self.streams.torch("learner")
        )
        return learner.weigh(context)

    def context(self, value_gradient: bool = False) -> FitContext:
        """The context of the learner; the footprint stands for the policy and its last steps."""
        rows = self.data.rows
        footprint = rows[self.data.footprint]
        return FitContext(
            replay=rows,
            policy_version=storage_order(len(rows)),
            policy_buffer=footprint,
            on_policy_steps=len(footprint),
            initial_obs=task.start_states(START_DRAWS, self.streams.torch("starts")),
            policy=clone(footprint, self.streams.torch("clone")),
            generator=self.streams.torch("weigh"),
            value_gradient=self.policy.value_gradient if value_gradient else None,
            # Those of the model before any weights: the data is weighed but once.
            model_errors=lambda: errors_of_rows(fit_linear(rows, uniform(rows, ready=True)), rows),
        )

    def roll_out_model(self) -> dict[str, float]:
        """Rollouts of the policy in the model from weighted states of the data."""
        config, generator = self.config.rollout, self.streams.torch("rollout")
        weights = self.weighting.for_starts(config)
        return roll_out(
            self.model,
            self.policy,
            task.at_goal,
            start_states(self.data.rows, weights, config.starts, generator),
            config.length_at(self.env_step),
            config,
            self.model_buffer,
            generator,
        )

    def optimise_policy(self) -> None:
        """Gradient steps of SAC on modelled transitions."""
        size, generator = self.config.sac.batch_size, self.streams.torch("batches")
        for _ in range(self.config.updates_per_step):
            rows = uniform_indices(len(self.model_buffer), size, generator)
            self._sac_metrics = self.policy.update(self.model_buffer.gather(rows))
        require_finite(self._sac_metrics, self.env_step)

    def evaluate(self) -> Iterator[Event]:
        """Episodes of the mean policy in the real task."""
        yield Metrics(self.env_step, {k: float(v[0]) for k, v in self._sac_metrics.items()})
        self.episodes = offline_data.drive(
            self.data.road_map,
            self.policy.mean,
            self.config.evaluation.episodes,
            self.streams.torch("evaluation"),
        )
        yield Evaluation(self.env_step, self.episodes)

    def drive_plan(self) -> Iterator[Event]:
        """The success of a planner with this model, driven in the real task."""
        driven = offline_data.drive(
            self.data.road_map,
            plan(self.model, self.config.sac.discount),
            self.config.evaluation.episodes,
            self.streams.torch("planner"),
        )
        mean, success = returns(driven)
        yield Metrics(self.env_step, {"planner/return": mean, "planner/success": success})

    def record(self) -> Iterator[Event]:
        """The current weights, model and trajectories."""
        step = self.env_step
        yield self.weighting.event(step, rows=len(self.data.rows))
        yield Field(step, "model", model_field(self.data.road_map, self.model))
        yield Field(step, "trajectories", trajectory_field(self.data.demonstrations, self.episodes))

    # State

    def state_dict(self) -> dict[str, Any]:
        """The state that determines the rest of the run; the data is made again from the seed."""
        weighting = self.weighting
        return {
            "env_step": self.env_step,
            "collected": 0,
            "policy": self.policy.state_dict(),
            "streams": self.streams.state_dict(),
            "model_buffer": self.model_buffer.state_dict(),
            "weights": weighting.weights,
            "per_dim": weighting.per_dim,
            "log_ratio": weighting.log_ratio,
            "terms": {} if weighting.terms is None else vars(weighting.terms),
            "ready": weighting.ready,
            "clipped": weighting.clipped,
            "coefficients": self.model.coefficients,
            "sac_metrics": self._sac_metrics,
        }

    def load_state_dict(self, state: dict[str, Any], collected: Collected) -> None:
        """Continue from `state_dict`."""
        self.env_step = state["env_step"]
        for part in ("policy", "streams", "model_buffer"):
            getattr(self, part).load_state_dict(state[part])
        self.weighting = Weighting(
            state["weights"],
            state["per_dim"],
            state["log_ratio"],
            of_recorded(state["terms"]),
            ready=state["ready"],
            clipped=state["clipped"],
        )
        self.model = RoadModel(state["coefficients"])
        self._sac_metrics = state["sac_metrics"]


def storage_order(rows: int) -> Tensor:
    """Policy versions (N,) of offline data: as in online runs, each row has its own version.

    The collecting policies are unknown, so PMAC uses the order of storage as the age.
    """
    return torch.arange(rows)
