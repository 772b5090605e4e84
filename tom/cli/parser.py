"""Options that commands share: those of a run, and those made from a configuration."""

import argparse
from collections.abc import Iterator
from pathlib import Path
from types import UnionType
from typing import Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo

from tom.errors import UserError

DEST = "config:"  # marks arguments that belong to the configuration


def folder(word: str) -> Path:
    """The type of a folder argument, for argparse."""
    if "://" in word:
        raise argparse.ArgumentTypeError(
            f"{word} is no folder; runs in an object store are fetched first: "
            "tom runs fetch s3://BUCKET/PREFIX --store runs"
        )
    return Path(word)


def seed_number(word: str) -> int:
    """The type of a seed, for argparse."""
    if not word.isdecimal():
        raise argparse.ArgumentTypeError(f"'{word}' is no seed: a whole number, 0 or more")
    return int(word)


def add_run_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that all training commands share."""
    group = parser.add_argument_group("where and how")
    group.add_argument("--store", type=folder, default=Path("runs"), help="run store (runs/)")
    add_accept_versions(group)
    group.add_argument("--no-rerun", action="store_true", help="write files only, no recording")
    group.add_argument("--headless", action="store_true", help="no server, no browser")
    group.add_argument("--json", action="store_true", help="print the result as JSON")


def add_accept_versions(parser: argparse._ActionsContainer) -> None:
    """Add the option of all commands that resume runs."""
    parser.add_argument(
        "--accept-versions",
        action="store_true",
        help="go on with runs of other versions of torch, gymnasium or mujoco: other numbers",
    )


def add_config_options(
    parser: argparse.ArgumentParser, config: type[BaseModel], leave_out: set[str]
) -> None:
    """One option for each value of a configuration; nested groups are dotted (`--sac.lr`)."""
    group = parser.add_argument_group("settings (each overrides the preset)")
    for path, info in leaf_fields(config):
        if path in leave_out:
            continue
        option = "--" + path.replace("_", "-")
        group.add_argument(
            option, dest=DEST + path, metavar=_metavar(info), help=_help(info), default=None
        )


def leaf_fields(config: type[BaseModel], prefix: str = "") -> Iterator[tuple[str, FieldInfo]]:
    """(dotted path, field) of every value of a configuration."""
    for name, info in config.model_fields.items():
        kind = info.annotation
        if isinstance(kind, type) and issubclass(kind, BaseModel):
            yield from leaf_fields(kind, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", info


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
    first = error.errors(include_url=False)[0]
    option = "--" + ".".join(str(part) for part in first["loc"]).replace("_", "-")
    message = first["msg"].replace("Input should be", "must be")
    return UserError(f"{option} {first['input']}: {message}")


def _metavar(info: FieldInfo) -> str:
    kind = info.annotation
    if get_origin(kind) is Literal:
        return "|".join(str(choice) for choice in get_args(kind))
    if get_origin(kind) in (Union, UnionType):
        kind = next(k for k in get_args(kind) if k is not type(None))
    name = getattr(kind, "__name__", str(kind))
    return {"int": "N", "float": "X", "bool": "true|false", "str": "NAME"}.get(name, name.upper())


def _help(info: FieldInfo) -> str:
    text = (info.description or "").replace("%", "%%")
    default = info.get_default(call_default_factory=True)
    return f"{text} [{default}]".strip()
