"""The learners: one file and one registry line each."""

from collections.abc import Callable
from dataclasses import dataclass

import torch

from tom.config import RunConfig
from tom.errors import unknown
from tom.learners.base import Learner
from tom.learners.mle import MleLearner
from tom.learners.pmac import PmacLearner
from tom.learners.tom import TomLearner
from tom.learners.vagram import VagramLearner

Build = Callable[[RunConfig, int, int, torch.Generator], Learner]
"""(config, obs_dim, action_dim, generator) -> learner."""


@dataclass(frozen=True)
class LearnerEntry:
    """How a learner is shown and built."""

    label: str
    build: Build


LEARNERS: dict[str, LearnerEntry] = {
    "mle": LearnerEntry("MLE", lambda c, o, a, g: MleLearner()),
    "pmac": LearnerEntry("PMAC", lambda c, o, a, g: PmacLearner(c.pmac)),
    "tom": LearnerEntry("TOM", lambda c, o, a, g: TomLearner(c.tom, o, a, g)),
    "vagram": LearnerEntry("VaGram (MDN)", lambda c, o, a, g: VagramLearner(c.vagram)),
    "vagram-ensemble": LearnerEntry(
        "VaGram (Ensemble)", lambda c, o, a, g: VagramLearner(c.vagram, "vagram-ensemble")
    ),
}

LEARNER_NAMES: tuple[str, ...] = tuple(LEARNERS)
FOLLOW_THE_VALUE = ("vagram", "vagram-ensemble")
"""learners whose weights come from a value function and change with it"""


def make_learner(
    name: str, config: RunConfig, obs_dim: int, action_dim: int, generator: torch.Generator
) -> Learner:
    """The learner called `name`; `generator` draws its first parameters.

    Raises UserError where there is none of that name.
    """
    if name not in LEARNERS:
        raise unknown("learner", name, LEARNERS)
    return LEARNERS[name].build(config, obs_dim, action_dim, generator)
