"""PMER: rows that the last model predicts badly are drawn more often, beside uniform ones."""

from typing import Any

from torch import Tensor

from tom.config import PmerConfig
from tom.data.sampling import normalise
from tom.learners.base import DEGENERATE, FitContext, Weighting, uniform


def error_weights(error: Tensor, config: PmerConfig) -> tuple[Tensor, bool]:
    """1 - share + share e^sharpness / mean(e^sharpness) of errors e (N,); whether degenerate."""
    by_error, degenerate = normalise(error.pow(config.sharpness))
    return 1 - config.share + config.share * by_error, degenerate


class PmerLearner:
    """Weights by the last model's error; the model is the training's, so it keeps nothing.

    Uniform, and not ready, before the first fit.
    """

    def __init__(self, config: PmerConfig) -> None:
        self.config = config

    def weigh(self, context: FitContext) -> Weighting:
        if context.model_errors is None:
            return uniform(context.replay, ready=False)
        weights, degenerate = error_weights(context.model_errors(), self.config)
        return Weighting(
            weights=weights,
            ready=not degenerate,
            notices=(DEGENERATE,) if degenerate else (),
        )

    def state_dict(self) -> dict[str, Any]:
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        pass
