"""The settings of a run as fields of a form, made from its configuration. Pure functions."""

import shlex
from collections.abc import Mapping, Sequence
from functools import reduce
from typing import Any, Literal, NamedTuple, get_args, get_origin

from pydantic import ValidationError

from tom import plugins
from tom.cli.parser import leaf_fields, one_line
from tom.errors import UserError
from tom.learners import others_groups
from tom.training.presets import config_type, resolve

LEFT_OUT = {"env", "learner", "preset", "seed", "steps"}
"""settings with separate fields above the others"""
GENERAL = "run"


class Setting(NamedTuple):
    """One value of a configuration; without `choices` it is a text field."""

    path: str
    label: str
    help: str
    default: str
    choices: tuple[str, ...]


def sections(env: str, learner: str, preset: str) -> dict[str, list[Setting]]:
    """The settings of an environment's runs by group, with the preset's values as defaults.

    The groups of other learners are left out, because they have no effect.
    """
    config = resolve(env, learner, preset)
    groups: dict[str, list[Setting]] = {}
    for path, info in leaf_fields(config_type(env, learner)):
        if path in LEFT_OUT:
            continue
        group, _, name = path.rpartition(".")
        if group in others_groups(learner):
            continue
        value: Any = reduce(getattr, path.split("."), config)
        choices: tuple[str, ...] = ()
        if get_origin(info.annotation) is Literal:
            choices = tuple(str(choice) for choice in get_args(info.annotation))
        elif info.annotation is bool:
            choices = ("true", "false")
        words = f"{value:g}" if isinstance(value, float) else str(value).lower()
        field = Setting(path, name.replace("_", " "), info.description or "", words, choices)
        groups.setdefault(group or GENERAL, []).append(field)
    return groups


def train_arguments(
    env: str, learner: str, preset: str, seed: int, given: Mapping[str, str], store: str
) -> list[str]:
    """The arguments of `tom` that start a run with the settings `given` (path: text).

    Raises UserError, in one line, for an invalid value.
    """
    nested: dict[str, Any] = {"seed": seed}
    for path, words in given.items():
        *groups, name = path.split(".")
        level = reduce(lambda at, group: at.setdefault(group, {}), groups, nested)
        level[name] = None if words.lower() == "none" else words
    try:
        config = resolve(env, learner, preset, nested)
    except ValidationError as error:
        raise one_line(error) from None
    explored = getattr(config, "exploration_steps", 0)  # offline runs have no exploration
    if config.steps <= explored:
        raise UserError(
            f"{config.steps:,} steps are all exploration, so nothing is learnt: ask for more than "
            f"{explored:,}, or set exploration steps lower"
        )
    options = [f"--{path.replace('_', '-')}={words}" for path, words in given.items()]
    chosen = ["--env", env, "--learner", learner, "--preset", preset, "--seed", str(seed)]
    return ["train", *chosen, *options, "--store", store]


def command_line(arguments: Sequence[str]) -> str:
    """The command as one types it in a terminal, with the plug-ins of this studio."""
    given = [word for name in plugins.wanted_here() for word in (plugins.OPTION, name)]
    return shlex.join(["tom", *arguments, *given])
