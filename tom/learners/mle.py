"""MLE: maximum likelihood on all past experience, with the same weight for all transitions."""

from tom.learners.base import FitContext, Stateless, Weighting, uniform


class MleLearner(Stateless):
    """Weight one for every transition (paper, eq. 2)."""

    def weigh(self, context: FitContext) -> Weighting:
        return uniform(context.replay, ready=True)
