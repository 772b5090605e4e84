"""MLE: maximum likelihood on all past experience, with the same weight for all transitions."""

from typing import Any

from tom.learners.base import FitContext, Weighting, uniform


class MleLearner:
    """Weight one for every transition (paper, eq. 2)."""

    def weigh(self, context: FitContext) -> Weighting:
        return uniform(context.replay, ready=True)

    def state_dict(self) -> dict[str, Any]:
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        pass
