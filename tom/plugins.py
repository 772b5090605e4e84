"""Plug-ins: user modules that register learners, tasks, termination rules, metrics and pages.

A plug-in has one function, `register(registry)`. It is code that the user chose to run, by
`--plugin FILE.py|module` or by installing a package with an entry point in the group `tom_studio`.
Its entries go into the same registries as ours. A run records the names of the plug-ins that it
needs; nothing is ever imported because a run names it.
"""

import importlib.util
import json
import os
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from types import ModuleType
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
from tom.envs.ends import LEARNT, RULES
from tom.envs.gymnasium_task import STEPS, look_at
from tom.envs.user_code import import_named, remember
from tom.errors import OF_USERS, UserError, reason
from tom.harmless import terminal
from tom.learners import LEARNERS, LearnerEntry
from tom.learners.base import Learner
from tom.learners.own import OwnLearner
from tom.metrics import FATAL, METRICS, OURS
from tom.road.baselines import BASELINES

GROUP = "tom_studio"
VARIABLE = "TOM_STUDIO_PLUGINS"
"""tells child processes which plug-ins the user named"""
OPTION = "--plugin"
NAME = re.compile(r"[a-z0-9][a-z0-9-]{0,39}")
COLOUR = re.compile(r"#[0-9a-f]{6}")
OUR_SETTINGS = frozenset(
    name for kind in (OnlineConfig, RoadConfig, SacRecordingConfig) for name in kind.model_fields
)

Make = Callable[[Any, int, int, torch.Generator], Learner]
"""(config, obs_dim, action_dim, generator) -> learner; the config has the learner's settings."""
Chart = Callable[[Sequence[Any], int], Any]
"""(curves, height) -> a Plotly figure; a curve has `run_id`, `learner`, `step` and `value`."""


@dataclass(frozen=True)
class Page:
    """A page of the studio from a plug-in, with the same attributes as a module of our pages."""

    TITLE: str
    ICON: str
    PATH: str
    page: Callable[[], None]


CHARTS: dict[str, Chart] = {}
PAGES: list[Page] = []
_LOADED: dict[str, str] = {}  # what was loaded -> the plug-in's name
_OWNERS: dict[tuple[str, str], str] = {}  # (kind, name) -> the plug-in's name


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
            raise UserError(f"plug-in {self.plugin}: '{group}' is the name of our own settings")
        if colour is not None and not COLOUR.fullmatch(colour):
            raise UserError(f"plug-in {self.plugin}: colour '{colour}' is not written #rrggbb")
        if not callable(make):
            raise UserError(f"plug-in {self.plugin}: make of the learner '{name}' is no function")
        if settings is not None:
            self._check_settings(name, settings)

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
            known = look_at(name, gym_id, terminated)
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
        """Register a metric's meaning and its chart on the Live page [default: one line per run].

        With `advice` (what to try), a value that is not finite ends the training.
        """
        if path in METRICS or path in OURS:
            raise UserError(f"plug-in {self.plugin}: there is a metric '{path}' already")
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

    def _check_settings(self, name: str, settings: type[Config]) -> None:
        """Raises UserError unless the settings have defaults: other runs' options list them too."""
        if not (isinstance(settings, type) and issubclass(settings, Config)):
            raise UserError(
                f"plug-in {self.plugin}: the settings of the learner '{name}' must be a subclass "
                "of tom.config.Config"
            )
        try:
            settings()
        except ValidationError as error:
            wrong = ".".join(str(part) for part in error.errors()[0]["loc"])
            raise UserError(
                f"plug-in {self.plugin}: the setting '{wrong}' of the learner '{name}' needs a "
                "default that it accepts"
            ) from error

    def _own(self, kind: str, name: str, taken: Sequence[str] | Mapping[str, Any]) -> None:
        if not NAME.fullmatch(name):
            raise UserError(
                f"plug-in {self.plugin}: the {kind} '{name}' wants a name of small letters, digits "
                "and -"
            )
        if name in taken:
            raise UserError(f"plug-in {self.plugin}: there is a {kind} '{name}' already")
        _OWNERS[kind, name] = self.plugin


def load(named: Sequence[str] = ()) -> None:
    """Load installed plug-ins, those that the parent process named, and `named`.

    Child processes will load the same. Raises UserError if one cannot be loaded; a broken installed
    plug-in is skipped with one line on stderr.
    """
    for point in entry_points(group=GROUP):
        _load_installed(point)
    wanted = list(dict.fromkeys([*wanted_here(), *map(_absolute, named)]))
    for word in wanted:
        _load(word)
    if wanted:
        os.environ[VARIABLE] = json.dumps(wanted)


def wanted_here() -> list[str]:
    """The plug-ins that the user named to this process, or to the one that started it."""
    return json.loads(os.environ.get(VARIABLE, "[]"))


def needed(config: RunConfig) -> list[str]:
    """The names of the plug-ins that a run of this configuration needs."""
    rule = getattr(getattr(config, "model", None), "termination", None)
    uses = ("learner", config.learner), ("task", config.env), ("termination", rule or "")
    return sorted({_OWNERS[use] for use in uses if use in _OWNERS})


def require(run_id: str, names: object) -> None:
    """Raises UserError for the first plug-in of a run's `names` that is not loaded."""
    for name in names if isinstance(names, list) else ():
        if name not in _LOADED.values():
            raise UserError(
                f"run '{run_id}' was made with the plug-in {name}: add {OPTION} {name} (its file "
                "or module, where it lies now)"
            )


def _absolute(word: str) -> str:
    return str(Path(word).absolute()) if _is_file(word) else word


def _is_file(word: str) -> bool:
    return word.endswith(".py") or "/" in word


def _load(word: str) -> None:
    if word in _LOADED or (word in _LOADED.values() and not _is_file(word)):
        return
    name = Path(word).name if _is_file(word) else word
    module = _of_file(Path(word)) if _is_file(word) else import_named(word, f"{OPTION} {word}")
    _register(getattr(module, "register", None), name)
    _LOADED[word] = name


def _load_installed(point: EntryPoint) -> None:
    key = f"{GROUP}:{point.name}"
    if key in _LOADED:
        return
    try:
        module = point.load()
        _register(getattr(module, "register", module), point.name)
        remember(point.module, sys.modules[point.module])
        _LOADED[key] = point.name
    except OF_USERS as error:  # a broken package must not stop every command
        said = f"tom: the installed plug-in {point.name} is left out: {reason(error)}"
        print(terminal(said), file=sys.stderr)


def _of_file(path: Path) -> ModuleType:
    if not path.is_file():
        raise UserError(f"{OPTION} {path}: there is no such file")
    name = f"tom_plugin_{re.sub(r'[^A-Za-z0-9]', '_', path.stem)}"
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise UserError(f"{OPTION} {path}: no Python file")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    try:
        spec.loader.exec_module(module)
    except OF_USERS as error:  # the user's own code
        raise UserError(_failure(str(path), error)) from error
    remember(str(path), module)
    return module


def _register(register: object, name: str) -> None:
    if not callable(register):
        raise UserError(f"plug-in {name} has no function register(registry)")
    try:
        register(Registry(name))
    except UserError:
        raise
    except OF_USERS as error:
        raise UserError(_failure(name, error)) from error


def _failure(name: str, error: BaseException) -> str:
    return f"plug-in {name} fails: {type(error).__name__}: {reason(error)}"
