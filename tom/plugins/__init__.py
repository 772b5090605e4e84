"""Plug-ins: user modules that register learners, tasks, termination rules, metrics and pages.

A plug-in has one function, `register(registry)`. It is code that the user chose to run, by
`--plugin FILE.py|module` or by installing a package with an entry point in the group `tom_studio`.
Its entries go into the same registries as ours. A run records the names of the plug-ins that it
needs; nothing is ever imported because a run names it.

Where there are none, loading them imports none of our registries, which take seconds.
"""

import json
import os
import sys
from collections.abc import Sequence
from importlib.metadata import entry_points
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tom.errors import USER_CODE_ERRORS, UserError, reason
from tom.harmless import terminal
from tom.plugins.kept import CHARTS, OWNERS, PAGES

if TYPE_CHECKING:
    from tom.config import RunConfig
    from tom.plugins.registry import Registry

__all__ = ["CHARTS", "PAGES", "Registry"]

GROUP = "tom_studio"
VARIABLE = "TOM_STUDIO_PLUGINS"
"""tells child processes which plug-ins the user named"""
OPTION = "--plugin"

_LOADED: dict[str, str] = {}  # what was loaded -> the plug-in's name


def __getattr__(name: str) -> Any:
    if name != "Registry":
        raise AttributeError(f"module 'tom.plugins' has no attribute '{name}'")
    from tom.plugins.registry import Registry

    return Registry


def given(arguments: Sequence[str]) -> list[str]:
    """The plug-ins that a command line names."""
    separate = [value for word, value in pairwise(arguments) if word == OPTION]
    joined = [word for word in arguments if word.startswith(f"{OPTION}=")]
    return separate + [word.partition("=")[2] for word in joined]


def load(named: Sequence[str] = ()) -> None:
    """Load installed plug-ins, those that the parent process named, and `named`.

    Child processes will load the same. Raises UserError if one cannot be loaded; a broken installed
    plug-in is skipped with one line on stderr.
    """
    for point in entry_points(group=GROUP):
        key = f"{GROUP}:{point.name}"
        if key in _LOADED:
            continue
        from tom.envs.user_code import register_module

        try:
            module = point.load()
            _register(getattr(module, "register", module), point.name)
            register_module(point.module, sys.modules[point.module])
            _LOADED[key] = point.name
        except USER_CODE_ERRORS as error:  # a broken package must not stop every command
            message = f"tom: the installed plug-in {point.name} is left out: {reason(error)}"
            print(terminal(message), file=sys.stderr)
    placed = (str(Path(word).absolute()) if _is_file(word) else word for word in named)
    wanted = list(dict.fromkeys([*wanted_here(), *placed]))
    for word in wanted:
        _load(word)
    if wanted:
        os.environ[VARIABLE] = json.dumps(wanted)


def wanted_here() -> list[str]:
    """The plug-ins that the user named to this process, or to the one that started it."""
    return json.loads(os.environ.get(VARIABLE, "[]"))


def needed(config: "RunConfig") -> list[str]:
    """The names of the plug-ins that a run of this configuration needs."""
    rule = getattr(getattr(config, "model", None), "termination", None)
    uses = ("learner", config.learner), ("task", config.env), ("termination", rule or "")
    return sorted({OWNERS[use] for use in uses if use in OWNERS})


def require(run_id: str, names: object) -> None:
    """Raises UserError for the first plug-in of a run's `names` that is not loaded."""
    for name in names if isinstance(names, list) else ():
        if name not in _LOADED.values():
            raise UserError(
                f"run '{run_id}' was made with the plug-in {name}: add {OPTION} {name} (its file "
                "or module, where it lies now)"
            )


def _is_file(word: str) -> bool:
    return word.endswith(".py") or "/" in word


def _load(word: str) -> None:
    """Load a module or a file. Raises UserError."""
    if word in _LOADED or (word in _LOADED.values() and not _is_file(word)):
        return
    from tom.envs.user_code import import_named

    module = import_named(word, f"{OPTION} {word}", Path(word) if _is_file(word) else None)
    name = Path(word).name if _is_file(word) else word
    _register(getattr(module, "register", None), name)
    _LOADED[word] = name


def _register(register: object, name: str) -> None:
    from tom.plugins.registry import Registry

    if not callable(register):
        raise UserError(f"plug-in {name} has no function register(registry)")
    try:
        register(Registry(name))
    except UserError:
        raise
    except USER_CODE_ERRORS as error:
        raise UserError(f"plug-in {name} fails: {type(error).__name__}: {reason(error)}") from error
