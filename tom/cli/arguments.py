"""The argument parser: one-line errors with a suggestion."""

import argparse
import sys
from difflib import get_close_matches
from typing import Any, NoReturn

from tom import plugins


class Parser(argparse.ArgumentParser):
    """An argument parser whose errors are one line and suggest the nearest known option.

    Options cannot be abbreviated: `--seed 3` does not mean `--seeds 3`.
    """

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, allow_abbrev=False, **options)
        self.add_argument(
            plugins.OPTION,
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
