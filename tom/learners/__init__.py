"""The learners: one file and one registry line each."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import torch

from tom.config import RunConfig
from tom.errors import unknown
from tom.learners.base import Learner
from tom.learners.mle import MleLearner
from tom.learners.pmac import PmacLearner
from tom.learners.ratio import RatioLearner
from tom.learners.tom import TomLearner
from tom.learners.vagram import VagramLearner

Build = Callable[[RunConfig, int, int, torch.Generator], Learner]
"""(config, obs_dim, action_dim, generator) -> learner."""


@dataclass(frozen=True)
class LearnerEntry:
    """How a learner is shown and built, and what else goes by its name.

    `colour` is its own in every figure. `group` names the settings it reads (a field of
    `RunConfig`); they are shown for it alone and set only its runs apart. `uniform`: it counts all
    transitions the same. `follows_value`: its weights come from a value function and change with
    it. `settings` change the preset of its online runs.
    """

    label: str
    build: Build
    colour: str | None = None
    group: str | None = None
    uniform: bool = False
    follows_value: bool = False
    settings: Mapping[str, Any] = field(default_factory=dict)


# Colours: at least 3:1 against light and dark; any two differ by 14 or more (CIE 1976) under
# normal, red-blind, green-blind and blue-blind vision. tests/app/test_theme.py measures both.
LEARNERS: dict[str, LearnerEntry] = {
    "mle": LearnerEntry("MLE", lambda *_: MleLearner(), "#2b6fe0", uniform=True),
    "pmac": LearnerEntry("PMAC", lambda c, o, a, g: PmacLearner(c.pmac), "#0c8577", "pmac"),
    "tom": LearnerEntry("TOM", lambda c, o, a, g: TomLearner(c.tom, o, a, g), "#c8441c", "tom"),
    "ratio": LearnerEntry(
        "Ratio", lambda c, o, a, g: RatioLearner(c.tom, o, a, g), "#849060", "tom"
    ),
    "vagram": LearnerEntry(
        "VaGram (MDN)",
        lambda c, o, a, g: VagramLearner(c.vagram),
        "#e056c0",
        "vagram",
        follows_value=True,
    ),
    "vagram-ensemble": LearnerEntry(
        "VaGram (Ensemble)",
        lambda c, o, a, g: VagramLearner(c.vagram),
        "#bd8d12",
        "vagram",
        follows_value=True,
        settings={"model": {"kind": "mean-ensemble"}},
    ),
}

LEARNER_NAMES: tuple[str, ...] = tuple(LEARNERS)
FOLLOW_THE_VALUE = tuple(name for name, entry in LEARNERS.items() if entry.follows_value)


def others_groups(learner: str) -> frozenset[str]:
    """The groups of settings that only other learners read: they change nothing in its runs."""
    groups = {entry.group for entry in LEARNERS.values() if entry.group}
    own = LEARNERS[learner].group if learner in LEARNERS else None
    return frozenset(groups - {own})


def make_learner(
    name: str, config: RunConfig, obs_dim: int, action_dim: int, generator: torch.Generator
) -> Learner:
    """The learner called `name`; `generator` draws its first parameters.

    Raises UserError where there is none of that name.
    """
    if name not in LEARNERS:
        raise unknown("learner", name, LEARNERS)
    return LEARNERS[name].build(config, obs_dim, action_dim, generator)
