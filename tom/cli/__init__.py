"""The command line. Each command is a module or package with `add_parser` and `run`."""

import importlib
import os
import sys
from collections.abc import Sequence
from contextlib import suppress

from tom import __version__, plugins
from tom.cli.arguments import Parser
from tom.errors import UserError, reason
from tom.harmless import terminal

COMMANDS = {
    "demo": "train two small comparisons while the studio shows them",
    "train": "train a learner in an environment",
    "studio": "open the studio in the browser",
    "record-sac": "record SAC's replay in order, for `tom weigh`",
    "weigh": "weigh recorded data by a policy",
    "brush": "fit a small model with a region of the buffer counting more or less",
    "sweep": "train many: every environment with every learner and seed",
    "reproduce": "reproduce a claim of the paper",
    "bench": "measure this machine",
    "runs": "list, label, check, export and tidy the runs of a store",
    "doctor": "check this machine and the store",
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return 0 (done) or one of the codes in `tom.errors`, with a line on why.

    Ctrl-C is left to the console script (`tom.__main__`).
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    if arguments[:1] == ["studio"]:
        from tom.cli import studio

        studio.hand_over(arguments[1:])
    try:
        plugins.load(plugins.given(arguments))
        args = build_parser(arguments).parse_args(arguments)
        from tom.cli.named import bring_named

        bring_named(args)
        code = args.run(args)
        sys.stdout.flush()
        return code
    except UserError as error:
        print(f"tom: {terminal(error)}", file=sys.stderr)
        return error.exit_code
    except BrokenPipeError:
        _close_stdout()
        return 1
    except OSError as error:
        print(f"tom: {terminal(error)}", file=sys.stderr)
        return 2
    except MemoryError as error:
        print(f"tom: not enough memory ({reason(error)}): free some", file=sys.stderr)
        return 1


def _close_stdout() -> None:
    """Nobody reads stdout any more: flushing its buffer at exit would raise an error."""
    with suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def build_parser(arguments: Sequence[str] = ()) -> Parser:
    """The parser of the commands that `arguments` name; of the others it knows the name alone.

    Commands take seconds to import.
    """
    parser = Parser(
        prog="tom",
        description="See which data a learned dynamics model pays attention to, while it trains.",
    )
    parser.add_argument("--version", action="version", version=f"tom {__version__}")
    subparsers = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for name, summary in COMMANDS.items():
        if name in arguments:
            command = importlib.import_module(f"tom.cli.{name.replace('-', '_')}")
            command.add_parser(subparsers, list(arguments))
        else:
            subparsers.add_parser(name, help=summary)
    return parser
