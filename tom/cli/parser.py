"""Options that commands share: those of every command, of a training, and of a configuration."""

import argparse
from collections.abc import Iterator
from contextlib import suppress
from itertools import takewhile
from pathlib import Path
from types import UnionType
from typing import Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo

from tom.errors import UserError, invalid_value

DEST = "config:"  # marks arguments that belong to the configuration
TERMINATION = "model.termination"


def folder(text: str) -> Path:
    """The type of a folder argument, for argparse."""
    if "://" in text:
        raise argparse.ArgumentTypeError(
            f"{text} is not a folder: `tom sweep` trains into an object store, and "
            "`tom runs fetch s3://BUCKET/PREFIX --store runs` brings its runs here"
        )
    return Path(text)


def add_store(parser: argparse._ActionsContainer) -> None:
    parser.add_argument("--store", type=folder, default=Path("runs"), help="run store [runs/]")


def add_json(parser: argparse._ActionsContainer, text: str = "print JSON") -> None:
    parser.add_argument("--json", action="store_true", help=text)


def add_accept_versions(parser: argparse._ActionsContainer) -> None:
    parser.add_argument(
        "--accept-versions",
        action="store_true",
        help="continue runs of other versions of torch, gymnasium or mujoco; their numbers change",
    )


def add_run_options(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("where and how")
    add_store(group)
    add_accept_versions(group)
    group.add_argument("--no-rerun", action="store_true", help="write files only, no recording")
    group.add_argument("--headless", action="store_true", help="no server, no browser")
    add_json(group, "print the result as JSON")


def add_training_options(
    parser: argparse.ArgumentParser, arguments: list[str], leave_out: set[str]
) -> None:
    """Add the options of `tom train` and `tom sweep`: preset, short forms, all settings.

    The settings are those of the environment that `arguments` name.
    """
    # Imported here because `tom runs` needs none of them.
    from tom.envs import ROAD
    from tom.learners import LEARNERS, SUBJECT
    from tom.training.presets import PRESETS, config_type, resolve

    env = ROAD if named(arguments, "--env") == {ROAD} else ""
    usual: BaseModel | None = None
    if {"-h", "--help"}.intersection(arguments):  # it shows the named task's defaults
        asked = {name: named(arguments, f"--{name}") for name in ("env", "learner", "preset")}
        with suppress(UserError):  # without these, those of the classes are shown
            usual = resolve(
                min(asked["env"], default="hopper"),
                min(asked["learner"], default=SUBJECT),
                min(asked["preset"], default=None),
            )
    parser.add_argument(
        "--preset", metavar="PRESET", help=f"{', '.join(PRESETS)} [mended for TOM, else paper]"
    )
    parser.add_argument(
        "--model", dest=DEST + "model.kind", metavar="KIND", help="short for --model.kind"
    )
    if env != ROAD:
        parser.add_argument(
            "--termination",
            dest=DEST + TERMINATION,
            metavar="module:function",
            help="what ends an episode in the model: next observations (B, O) in the task's units "
            "-> bool (B,); or never; or learnt, by a head of the model (short for "
            "--model.termination)",
        )
    if env == ROAD:
        leave_out = leave_out | {"device"}  # it always trains on the CPU
    add_config_options(parser, config_type(env, *LEARNERS), leave_out, usual)


def named(arguments: list[str], option: str) -> set[str]:
    """The words that a command line gives to an option, before it is parsed."""
    found: set[str] = set()
    for index, argument in enumerate(arguments):
        if argument.startswith(option + "="):
            found.add(argument.split("=", 1)[1])
        elif argument == option:
            found |= set(takewhile(lambda word: word[:1] != "-", arguments[index + 1 :]))
    return found


def import_named(args: argparse.Namespace) -> None:
    """Import the modules of the tasks and the termination rule that the command line names.

    Raises UserError if there is no such module.
    """
    env, rule = getattr(args, "env", None), getattr(args, DEST + TERMINATION, None)
    if env is None and rule is None:
        return
    from tom.envs import import_task  # a simulator takes a second to import
    from tom.envs.termination import import_rule

    for name in env if isinstance(env, list) else [env]:
        import_task(name)
    import_rule(rule)


def add_config_options(
    parser: argparse.ArgumentParser,
    config: type[BaseModel],
    leave_out: set[str],
    usual: BaseModel | None = None,
) -> None:
    """One option for each value of a configuration; nested groups are dotted (`--sac.lr`).

    The defaults in its help are those of `usual`, and of the class for what that lacks.
    """
    group = parser.add_argument_group("settings (each overrides the preset)")
    for path, info in leaf_fields(config):
        if path not in leave_out:
            option = "--" + path.replace("_", "-")
            text = (info.description or "").replace("%", "%%")
            of_class = info.get_default(call_default_factory=True)
            default: Any = usual
            for name in path.split("."):
                default = getattr(default, name, of_class)
            group.add_argument(
                option, dest=DEST + path, metavar=_metavar(info), help=f"{text} [{default}]".strip()
            )


def leaf_fields(config: type[BaseModel], prefix: str = "") -> Iterator[tuple[str, FieldInfo]]:
    """(dotted path, field) of every value of a configuration."""
    for name, info in config.model_fields.items():
        kind = info.annotation
        if isinstance(kind, type) and issubclass(kind, BaseModel):
            yield from leaf_fields(kind, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", info


def _metavar(info: FieldInfo) -> str:
    kind = info.annotation
    if get_origin(kind) is Literal:
        return "|".join(map(str, get_args(kind)))
    if get_origin(kind) in (Union, UnionType):
        kind = next(k for k in get_args(kind) if k is not type(None))
    name = getattr(kind, "__name__", str(kind))
    return {"int": "N", "float": "X", "bool": "true|false", "str": "NAME"}.get(name, name.upper())


def overrides(args: argparse.Namespace) -> dict[str, Any]:
    """The configuration values given on the command line, as a nested dict."""
    nested: dict[str, Any] = {}
    for dest, value in vars(args).items():
        if not dest.startswith(DEST) or value is None:
            continue
        *groups, name = dest.removeprefix(DEST).split(".")
        level = nested
        for group in groups:
            level = level.setdefault(group, {})
        level[name] = None if str(value).lower() == "none" else value
    return nested


def one_line(error: ValidationError) -> UserError:
    """Pydantic's first error as one line that names the option."""
    path, space, problem = invalid_value(error).partition(" ")
    return UserError(f"--{path.replace('_', '-')}{space}{problem}")
