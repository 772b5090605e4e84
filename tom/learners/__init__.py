"""The learners: one file and one registry line each.

A learner's file is imported when it is built: whoever only shows runs needs no torch.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib import import_module
from typing import TYPE_CHECKING, Any, TypeVar

from pydantic import create_model

from tom.config import (
    OWN_LOOP,
    SAC_ALONE,
    ActionRatioConfig,
    Config,
    PdmlConfig,
    PmerConfig,
    PolicyDistanceConfig,
    RunConfig,
)
from tom.errors import check_known

if TYPE_CHECKING:
    import torch

    from tom.learners.base import Learner

C = TypeVar("C", bound=Config)

Build = Callable[[RunConfig, int, int, "torch.Generator"], "Learner"]
"""(config, obs_dim, action_dim, generator) -> learner."""


@dataclass(frozen=True)
class LearnerEntry:
    """How a learner is shown and built, and its other properties.

    `colour` is its colour in every figure. `group` names the settings it reads (a field of
    `RunConfig`); they are shown only for it and distinguish only its runs. `uniform`: all
    transitions have the same weight. `follows_value`: its weights depend on a value function and
    change with it. `follows_behaviour`: they need the policy that drew each row's action.
    `follows_model`: they need the last model's errors.
    `has_terms`: its weights come from a dual Q under `TomConfig`, and their terms
    are recorded (`tom.learners.terms`). `clipped`: the fit clips its weights, as
    `Weighting.clipped` says. `charts` are its own metrics in a run's layout, by title. `settings`
    change the preset of its online runs. `own` is the class of settings that only the configuration
    of its own runs has, as `group` (`with_own_settings`).
    """

    label: str
    build: Build
    colour: str | None = None
    group: str | None = None
    uniform: bool = False
    follows_value: bool = False
    follows_behaviour: bool = False
    follows_model: bool = False
    has_terms: bool = False
    clipped: bool = False
    charts: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    settings: Mapping[str, Any] = field(default_factory=dict)
    own: type[Config] | None = None


def _ours(
    label: str,
    path: str,
    colour: str,
    group: str | None = None,
    networks: bool = False,
    **more: Any,
) -> LearnerEntry:
    """The learner `module:Class` of this package, built from its group of settings, if it has one.

    With `networks` it gets the dimensions and the generator as well.
    """

    def build(
        config: RunConfig, obs_dim: int, action_dim: int, generator: "torch.Generator"
    ) -> "Learner":
        module, _, name = path.partition(":")
        settings = [] if group is None else [getattr(config, group)]
        rest = (obs_dim, action_dim, generator) if networks else ()
        return getattr(import_module(f"tom.learners.{module}"), name)(*settings, *rest)

    return LearnerEntry(label, build, colour, group, **more)


# Colours: at least 3:1 against light and dark; any two differ by 14 or more (CIE 1976) under
# normal, red-blind, green-blind and blue-blind vision. tests/app/test_theme.py measures both.
LEARNERS: dict[str, LearnerEntry] = {
    "mle": _ours("MLE", "mle:MleLearner", "#2b6fe0", uniform=True),
    "pmac": _ours("PMAC", "pmac:PmacLearner", "#0c8577", "pmac"),
    "tom": _ours(
        "TOM",
        "tom:TomLearner",
        "#c8441c",
        "tom",
        networks=True,
        has_terms=True,
        clipped=True,
        charts={
            "TOM: discriminator and dual Q": ("discriminator/loss", "dual/loss", "dual/q_mean")
        },
    ),
    "ratio": _ours("Ratio", "ratio:RatioLearner", "#849060", "tom", networks=True, clipped=True),
    "vagram": _ours(
        "VaGram (MDN)", "vagram:VagramLearner", "#e056c0", "vagram", follows_value=True
    ),
    "vagram-ensemble": _ours(
        "VaGram (Ensemble)",
        "vagram:VagramLearner",
        "#bd8d12",
        "vagram",
        follows_value=True,
        settings={"model": {"kind": "mean-ensemble"}},
    ),
    "pdml": _ours(
        "PDML", "pdml:PdmlLearner", "#a824a8", "pdml", follows_behaviour=True, own=PdmlConfig
    ),
    "policy-distance": _ours(
        "Policy distance",
        "policy_distance:PolicyDistanceLearner",
        "#9030fc",
        "policy_distance",
        follows_behaviour=True,
        own=PolicyDistanceConfig,
    ),
    "pmer": _ours(
        "PMER", "pmer:PmerLearner", "#a89048", "pmer", follows_model=True, own=PmerConfig
    ),
    "action-ratio": _ours(
        "Action ratio",
        "action_ratio:ActionRatioLearner",
        "#f04890",
        "action_ratio",
        follows_behaviour=True,
        own=ActionRatioConfig,
    ),
}

SUBJECT = "tom"
"""the main learner of this program, and the default selection of pages"""
WEIGHED_FIRST = (SUBJECT, "pmac", "mle")
"""the default learners of a weighing"""
WITH_TERMS = tuple(name for name, entry in LEARNERS.items() if entry.has_terms)


def learner_rank(learner: str) -> int:
    """The place of a learner in a table: as in the registry, unknown ones last."""
    return list(LEARNERS).index(learner) if learner in LEARNERS else len(LEARNERS)


def learner_label(learner: str) -> str:
    """The label of a learner; its plain name if it is not in the registry."""
    others = {SAC_ALONE: "SAC", OWN_LOOP: "Own loop"}
    return LEARNERS[learner].label if learner in LEARNERS else others.get(learner, learner)


NEUTRAL = "#8a92a3"


def learner_colour(learner: str) -> str:
    """The colour of a learner; a neutral one if it has none."""
    entry = LEARNERS.get(learner)
    return entry.colour if entry and entry.colour else NEUTRAL


def follows_value(learner: str) -> bool:
    """Whether its weights change with a value function; those of a baseline, no learner, do not."""
    return learner in LEARNERS and LEARNERS[learner].follows_value


def follows_behaviour(learner: str) -> bool:
    """Whether its weights need the policy that drew each row's action."""
    return learner in LEARNERS and LEARNERS[learner].follows_behaviour


def others_groups(learner: str) -> frozenset[str]:
    """The groups of settings that only other learners read, so that they do not affect its runs."""
    groups = {entry.group for entry in LEARNERS.values() if entry.group}
    own = LEARNERS[learner].group if learner in LEARNERS else None
    return frozenset(groups - {own})


def with_own_settings(base: type[C], learners: Iterable[str]) -> type[C]:
    """`base` extended by the plug-in settings of `learners`; `base` itself if there are none."""
    own = {
        entry.group: entry.own
        for entry in (LEARNERS[name] for name in learners if name in LEARNERS)
        if entry.group and entry.own
    }
    return _extended(base, tuple(sorted(own.items()))) if own else base


@cache
def _extended(base: type[C], groups: tuple[tuple[str, type[Config]], ...]) -> type[C]:
    fields: dict[str, Any] = {name: (kind, kind()) for name, kind in groups}
    return create_model(base.__name__, __base__=base, __doc__=base.__doc__, **fields)


def make_learner(
    name: str, config: RunConfig, obs_dim: int, action_dim: int, generator: "torch.Generator"
) -> "Learner":
    """Make the learner `name`; `generator` draws its initial parameters.

    Raises UserError if there is no learner of that name.
    """
    check_known("learner", [name], LEARNERS)
    return LEARNERS[name].build(config, obs_dim, action_dim, generator)
