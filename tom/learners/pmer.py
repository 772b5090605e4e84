"""PMER: rows that the last model predicts badly are drawn more often, beside uniform ones."""

from torch import Tensor

from tom.config import PmerConfig
from tom.learners.base import FitContext, Stateless, Weighting, uniform, weighted


def error_weights(error: Tensor, config: PmerConfig) -> Tensor:
    """1 - share + share e^sharpness / mean(e^sharpness) of errors e (N,); NaN if all are 0."""
    by_error = error.pow(config.sharpness)
    return 1 - config.share + config.share * by_error / by_error.mean()


class PmerLearner(Stateless):
    """Weights by the last model's error; the model is the training's, so it keeps nothing.

    Uniform, and not ready, before the first fit.
    """

    def __init__(self, config: PmerConfig) -> None:
        self.config = config

    def weigh(self, context: FitContext) -> Weighting:
        if context.model_errors is None:
            return uniform(context.replay, ready=False)
        return weighted(error_weights(context.model_errors(), self.config))
