"""Baseline weightings on road-and-rocks, where the collecting policy of each row is known."""

from collections.abc import Callable

from torch import Tensor

from tom.config import TomConfig
from tom.data.sampling import normalise
from tom.data.scaling import Scaling
from tom.learners.base import FitContext, Weighting
from tom.learners.discriminator import Discriminator, RatioProblem, discriminator_net
from tom.learners.dual import DualProblem, QFunction, q_net
from tom.road.offline_data import OfflineData

Baseline = Callable[[OfflineData, FitContext, TomConfig], Weighting]


def expert_only(data: OfflineData, context: FitContext, config: TomConfig) -> Weighting:
    """All expert trajectories and nothing else."""
    return _among(data.expert)


def footprint_only(data: OfflineData, context: FitContext, config: TomConfig) -> Weighting:
    """Only the trajectory that TOM gets as the policy's footprint."""
    return _among(data.footprint)


def labels_swapped(data: OfflineData, context: FitContext, config: TomConfig) -> Weighting:
    """A control: TOM with the discriminator's labels swapped, which negates r."""
    log_ratio, metrics = discriminate(context, config)
    replay, generator = context.replay, context.generator
    scaling = Scaling.of((replay.obs, replay.action))
    problem = DualProblem(replay, -log_ratio, context.initial_obs, context.policy, config, scaling)
    q = QFunction(q_net(*_dims(context), config, generator), config)
    net = problem.minimise(q, generator).net
    weights, _ = normalise(problem.terms(net, generator).raw(config))
    return Weighting(weights, log_ratio=-log_ratio, metrics=metrics)


def discriminate(context: FitContext, config: TomConfig) -> tuple[Tensor, dict[str, float]]:
    """The logit (N,) of a fresh discriminator between policy buffer and replay, and metrics."""
    net = discriminator_net(*_dims(context), config, context.generator)
    ratio = RatioProblem.of(context.policy_buffer, context.replay, config.discriminator_input)
    trained, metrics = ratio.solve(Discriminator(net, config), context.generator)
    return ratio.log_ratio(trained), metrics


def _dims(context: FitContext) -> tuple[int, int]:
    return context.replay.obs.shape[1], context.replay.action.shape[1]


def _among(chosen: Tensor) -> Weighting:
    weights, _ = normalise(chosen.float())
    return Weighting(weights)


BASELINES: dict[str, Baseline] = {
    "expert-only": expert_only,
    "footprint-only": footprint_only,
    "labels-swapped": labels_swapped,
}
