"""What a plug-in may register."""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import torch
from pydantic import ValidationError

from tom.config import (
    SAC_ALONE,
    Config,
    OnlineConfig,
    RoadConfig,
    RunConfig,
    SacRecordingConfig,
)
from tom.envs import ENV_NAMES, OTHERS, Task, Termination
from tom.envs.gymnasium_task import STEPS, inspect_task
from tom.envs.termination import LEARNT, RULES
from tom.errors import UserError
from tom.learners import LEARNERS, LearnerEntry
from tom.learners.base import Learner
from tom.learners.own import OwnLearner
from tom.metrics import BUILT_IN, FATAL, METRICS
from tom.plugins.kept import CHARTS, OWNERS, PAGES, Chart, Page
from tom.road.baselines import BASELINES

NAME = re.compile(r"[a-z0-9][a-z0-9-]{0,39}")
COLOUR = re.compile(r"#[0-9a-f]{6}")
OUR_SETTINGS = frozenset(
    name for kind in (OnlineConfig, RoadConfig, SacRecordingConfig) for name in kind.model_fields
)

Make = Callable[[Any, int, int, torch.Generator], Learner]
"""(config, obs_dim, action_dim, generator) -> learner; the config has the learner's settings."""


class Registry:
    """The argument of `register`. Every method raises UserError for a taken or invalid name."""

    def __init__(self, plugin: str) -> None:
        self.plugin = plugin

    def learner(
        self,
        name: str,
        title: str,
        make: Make,
        colour: str | None = None,
        settings: type[Config] | None = None,
        *,
        uniform: bool = False,
        follows_value: bool = False,
    ) -> None:
        """Register a learner, called `title` on pages, drawn in `colour` (#rrggbb), else grey.

        `settings` is its own group of options, with defaults; `make` finds it in the config under
        the learner's name (`-` as `_`). `uniform` and `follows_value` are those of `LearnerEntry`.
        """
        self._own("learner", name, [*LEARNERS, SAC_ALONE, *BASELINES])
        group = None if settings is None else name.replace("-", "_")
        if group in OUR_SETTINGS:
            raise self._error(f"'{group}' is the name of our own settings")
        if colour is not None and not COLOUR.fullmatch(colour):
            raise self._error(f"colour '{colour}' is not written #rrggbb")
        try:
            if settings is not None:  # other runs' options list them too
                settings()
        except ValidationError as error:
            wrong = ".".join(str(part) for part in error.errors()[0]["loc"])
            raise self._error(
                f"the setting '{wrong}' of the learner '{name}' needs a default that it accepts"
            ) from error

        def build(config: RunConfig, obs_dim: int, action_dim: int, generator: torch.Generator):
            return OwnLearner(name, lambda: make(config, obs_dim, action_dim, generator))

        LEARNERS[name] = LearnerEntry(
            title, build, colour, group, uniform, follows_value, own=settings
        )

    def task(
        self,
        name: str,
        gym_id: str,
        terminated: Termination | None = None,
        *,
        steps: int = STEPS,
        obs_names: Sequence[str] = (),
        settings: Mapping[str, Any] | None = None,
    ) -> None:
        """Register a Gymnasium task under a new name; it is made on first use.

        `terminated` maps next observations (B, O) in the task's own units to a bool tensor (B,).
        `settings` change every preset but smoke, as nested dicts.
        """
        self._own("task", name, [*ENV_NAMES, *OTHERS])

        def made() -> Task:
            known = inspect_task(name, gym_id, terminated)
            if obs_names and len(obs_names) != known.obs_dim:
                raise UserError(f"task {name} observes {known.obs_dim} numbers, not so many names")
            named = tuple(obs_names) or known.obs_names
            return replace(known, steps=steps, obs_names=named, settings=dict(settings or {}))

        OTHERS[name] = cache(made)

    def termination(self, name: str, function: Termination) -> None:
        """Register a termination rule for `--termination NAME`, like `terminated` of a task."""
        self._own("termination", name, [*RULES, LEARNT])
        RULES[name] = function

    def metric(
        self, path: str, meaning: str, chart: Chart | None = None, advice: str | None = None
    ) -> None:
        """Register a metric's meaning and its chart on Curves [default: one line per run].

        With `advice` (what to try), a value that is not finite ends the training.
        """
        if path in METRICS or path in BUILT_IN:
            raise self._error(f"there is a metric '{path}' already")
        METRICS[path] = meaning
        if advice is not None:
            FATAL[path] = advice
        if chart is not None:
            CHARTS[path] = chart

    def page(
        self, title: str, path: str, page: Callable[[], None], icon: str = ":material/extension:"
    ) -> None:
        """Register a page of the studio at `/own-<path>`, drawn by `page()` with Streamlit."""
        address = f"own-{path}"  # none of our addresses begins with this
        self._own("page", path, [known.PATH.removeprefix("own-") for known in PAGES])
        PAGES.append(Page(title, icon, address, page))

    def _error(self, text: str) -> UserError:
        return UserError(f"plug-in {self.plugin}: {text}")

    def _own(self, kind: str, name: str, taken: Sequence[str] | Mapping[str, Any]) -> None:
        if not NAME.fullmatch(name):
            raise self._error(f"the {kind} '{name}' wants a name of small letters, digits and -")
        if name in taken:
            raise self._error(f"there is a {kind} '{name}' already")
        OWNERS[kind, name] = self.plugin
