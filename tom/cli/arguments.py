"""The argument parser: one-line errors with a suggestion, and the plug-ins of every command."""

import argparse
import sys
from collections.abc import Sequence
from difflib import get_close_matches
from itertools import pairwise
from typing import Any, NoReturn

PLUGIN = "--plugin"


class Parser(argparse.ArgumentParser):
    """An argument parser whose errors are one line and suggest the nearest known option.

    Options cannot be abbreviated: `--seed 3` does not mean `--seeds 3`.
    """

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, allow_abbrev=False, **options)
        self.add_argument(
            PLUGIN,
            action="append",
            metavar="FILE.py|MODULE",
            help="a plug-in of yours: its learners, tasks, metrics and pages join ours",
        )

    def error(self, message: str) -> NoReturn:
        print(f"{self.prog}: {message}; see {self.prog} --help", file=sys.stderr)
        raise SystemExit(2)

    def parse_known_args(self, args=None, namespace=None):  # type: ignore[override]
        parsed, rest = super().parse_known_args(args, namespace)
        if rest:
            known = [option for action in self._actions for option in action.option_strings]
            near = get_close_matches(rest[0].split("=")[0], known, n=1)
            hint = f", did you mean {near[0]}?" if near else ""
            self.error(f"unknown argument {rest[0]}{hint}")
        return parsed, rest


def named_plugins(arguments: Sequence[str]) -> list[str]:
    """The plug-ins that a command line names."""
    separate = [value for word, value in pairwise(arguments) if word == PLUGIN]
    joined = [word for word in arguments if word.startswith(f"{PLUGIN}=")]
    return separate + [word.partition("=")[2] for word in joined]
