"""Baseline weightings on road-and-rocks, where the collecting policy of each row is known."""

from collections.abc import Callable

from torch import Tensor

from tom.config import TomConfig
from tom.data.sampling import normalise
from tom.data.scaling import Scaling
from tom.learners.base import FitContext, Weighting
from tom.learners.discriminator import Discriminator, RatioProblem
from tom.learners.dual import DualProblem, QFunction
from tom.road.offline_data import OfflineData

Baseline = Callable[[OfflineData, FitContext, TomConfig], Weighting]


def labels_swapped(data: OfflineData, context: FitContext, config: TomConfig) -> Weighting:
    """A control: TOM with the discriminator's labels swapped, which negates r."""
    replay, generator = context.replay, context.generator
    dims = replay.obs.shape[1], replay.action.shape[1]
    ratio = RatioProblem.of(context.policy_buffer, replay, config)
    trained, metrics = ratio.solve(Discriminator(*dims, config, generator), generator)
    log_ratio = ratio.log_ratio(trained)
    scaling = Scaling.of((replay.obs, replay.action))
    problem = DualProblem(replay, -log_ratio, context.initial_obs, context.policy, config, scaling)
    net, _ = problem.minimise(QFunction(*dims, config, generator), generator)
    weights, _ = normalise(problem.terms(net, generator).raw(config))
    return Weighting(weights, log_ratio=-log_ratio, metrics=metrics)


def only(rows: Callable[[OfflineData], Tensor]) -> Baseline:
    """All weight on the rows with a mask (N,) of True."""

    def weigh(data: OfflineData, context: FitContext, config: TomConfig) -> Weighting:
        return Weighting(normalise(rows(data).float())[0])

    return weigh


BASELINES: dict[str, Baseline] = {
    "expert-only": only(lambda data: data.expert),
    "footprint-only": only(lambda data: data.footprint),
    "labels-swapped": labels_swapped,
}
