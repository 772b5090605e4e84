"""The command line: thin; a command is a module, or a package, with `add_parser` and `run`."""

import os
import sys
from collections.abc import Sequence
from contextlib import suppress

from tom import __version__
from tom.cli import bench, demo, doctor, record_sac, reproduce, runs, studio, sweep, train, weigh
from tom.cli.parser import Parser
from tom.errors import UserError
from tom.harmless import terminal

COMMANDS = (demo, train, studio, record_sac, weigh, sweep, reproduce, bench, runs, doctor)


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command: 0 done, 1 failed, 2 bad input (one line that names the fix)."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    if arguments[:1] == ["studio"]:
        studio.hand_over(arguments[1:])
    try:
        args = build_parser(arguments).parse_args(arguments)
        code = args.run(args)
        sys.stdout.flush()
        return code
    except UserError as error:
        print(f"tom: {terminal(error)}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("tom: stopped", file=sys.stderr)
        return 1
    except BrokenPipeError:
        _close_stdout()
        return 1


def _close_stdout() -> None:
    """Nobody reads any more: what is left in the buffer would be an error at the very end."""
    with suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def build_parser(arguments: Sequence[str] = ()) -> Parser:
    """The parser of every command; some options depend on what `arguments` ask for."""
    parser = Parser(
        prog="tom",
        description="See which data a learned dynamics model pays attention to, while it trains.",
    )
    parser.add_argument("--version", action="version", version=f"tom {__version__}")
    subparsers = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for command in COMMANDS:
        command.add_parser(subparsers, list(arguments))
    return parser


def script() -> None:
    """The console script."""
    raise SystemExit(main())
