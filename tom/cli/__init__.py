"""The command line. Each command is a module with `add_parser` and `run`."""

import argparse
import importlib
import os
import sys
from collections.abc import Sequence
from contextlib import suppress
from difflib import get_close_matches
from typing import Any, NoReturn

from tom import __version__, plugins
from tom.errors import BAD_INPUT, DISK_FULL, TRY_LATER, UserError, reason
from tom.harmless import terminal

COMMANDS = {
    "demo": "train two small comparisons and watch them in the studio",
    "train": "train a learner in an environment",
    "studio": "open the studio in the browser",
    "record-sac": "record SAC's replay in order, for `tom weigh`",
    "weigh": "weigh recorded data for a policy",
    "brush": "fit a small model in which a region of the buffer counts more or less",
    "answer": "where a learner looks, and whether that helps: one group of runs against another",
    "sweep": "train every environment with every learner and seed",
    "reproduce": "reproduce a claim of the paper",
    "bench": "measure this machine",
    "runs": "list, label, check, export and tidy the runs of a store",
    "doctor": "check this machine and the store",
}


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


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return 0 (done) or one of the codes in `tom.errors`, with a line on why.

    Ctrl-C is left to the console script (`tom.__main__`).
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    if arguments[:1] == ["studio"]:
        exec_module("app", arguments[1:])
    try:
        plugins.load(plugins.given(arguments))
        args = build_parser(arguments).parse_args(arguments)
        from tom.cli.parser import import_named

        import_named(args)
        code = args.run(args)
        sys.stdout.flush()
        return code
    except UserError as error:
        print(f"tom: {terminal(error)}", file=sys.stderr)
        return error.exit_code
    except ValueError as error:
        from pydantic import ValidationError  # imported by then, if it is one

        if not isinstance(error, ValidationError):
            raise
        from tom.cli.parser import one_line

        print(f"tom: {terminal(one_line(error))}", file=sys.stderr)
        return BAD_INPUT
    except BrokenPipeError:
        # Nobody reads stdout any more: flushing its buffer at exit would raise an error.
        with suppress(OSError, ValueError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except OSError as error:
        print(f"tom: {terminal(error)}", file=sys.stderr)
        return TRY_LATER if error.errno in DISK_FULL else BAD_INPUT
    except MemoryError as error:
        print(f"tom: not enough memory ({reason(error)}): free some", file=sys.stderr)
        return 1


def build_parser(arguments: Sequence[str] = ()) -> Parser:
    """The parser of the commands that `arguments` name; of the others it knows only the name.

    Commands take seconds to import.
    """
    parser = Parser(
        prog="tom",
        description="See which data a learned dynamics model pays attention to, while it trains.",
    )
    parser.add_argument("--version", action="version", version=f"tom {__version__}")
    subparsers = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for name, summary in COMMANDS.items():
        if name in arguments and name != "studio":
            command = importlib.import_module(f"tom.cli.{name.replace('-', '_')}")
            command.add_parser(subparsers, list(arguments))
        else:
            subparsers.add_parser(name, help=summary)
    return parser


def exec_module(module: str, arguments: Sequence[str]) -> NoReturn:
    """Replace this process by `python -m MODULE`: the backend never imports the studio."""
    sys.stdout.flush()
    os.execv(sys.executable, [sys.executable, "-m", module, *arguments])
