"""`python -m app` (and `tom studio`): the studio's command line."""

import argparse
import os
import re
import sys
from collections.abc import Sequence
from pathlib import Path

from app.links import Links
from app.servers.launcher import run
from tom import plugins
from tom.cli import Parser
from tom.cli.parser import folder
from tom.errors import UserError
from tom.harmless import terminal


def main(argv: Sequence[str] | None = None) -> int:
    """Open the studio until Ctrl-C: 0 stopped, 1 a server failed, 2 bad input."""
    try:
        plugins.load(plugins.given(sys.argv[1:] if argv is None else argv))
        args = _parser().parse_args(argv)
        store = _readable(args.store)
        if args.screenshots and args.cinema:
            raise UserError("--screenshots and --cinema are two commands: leave one out")
        if args.run and not args.cinema:
            raise UserError("--run needs --cinema DIR: add it, or choose the run on a page")
        if out := args.screenshots or args.cinema:  # before any server or browser starts
            places = out.absolute(), *out.absolute().parents
            there = next(path for path in places if path.exists())
            if not (there.is_dir() and os.access(there, os.W_OK | os.X_OK)):
                raise UserError(f"cannot write into {there}: name another folder")
        if args.screenshots:
            from app.servers.browser import (
                take_pictures,  # needs playwright, which only the test extra has
            )

            return take_pictures(store, args.screenshots)
        if args.cinema:
            from app.servers import cinema  # needs playwright, too

            return cinema.export(store, args.run, args.cinema, args.theme or "light")
        asked = Links(str(store), args.host, args.port, args.base_path, theme=args.theme)
        return run(asked, browser=not args.no_browser)
    except (UserError, OSError) as error:
        print(f"tom studio: {terminal(error)}", file=sys.stderr)
        return 2


def _parser() -> argparse.ArgumentParser:
    parser = Parser(
        prog="tom studio",
        description="Open the studio in the browser: where a learner looks and whether that helps, "
        "curves, attention, replays, findings. It writes into the store only what you ask for on a "
        "page.",
    )
    parser.add_argument("--store", type=folder, default=Path("runs"), help="run store [runs/]")
    parser.add_argument("--host", default="127.0.0.1", help="address to bind to [127.0.0.1]")
    parser.add_argument("--port", type=int, default=0, metavar="N", help="port of the pages [free]")
    parser.add_argument(
        "--base-path",
        type=base_path,
        default="",
        metavar="/PATH",
        help="path of the pages behind a proxy, such as JupyterHub or Open OnDemand",
    )
    parser.add_argument("--theme", choices=("light", "dark"), help="[the browser's]")
    parser.add_argument("--no-browser", action="store_true", help="print the address only")
    parser.add_argument(
        "--screenshots", type=Path, metavar="DIR", help="write a picture of every page and exit"
    )
    parser.add_argument(
        "--cinema", type=Path, metavar="DIR", help="write a run's story as HTML, MP4, WebP and exit"
    )
    parser.add_argument("--run", help="the run of --cinema [the most telling one]")
    return parser


def base_path(path: str) -> str:
    """The path with a slash at its end; empty if there is none. Raises ArgumentTypeError."""
    if not re.fullmatch(r"(/[\w.~@%+-]+)*/?", path):
        raise argparse.ArgumentTypeError(f"'{path}' is not a path such as /user/me/studio")
    return f"{path.rstrip('/')}/" if path else ""


def _readable(store: Path) -> Path:
    if store.exists() and not store.is_dir():
        raise UserError(f"--store {store} is a file: name a folder")
    if store.exists() and not os.access(store, os.R_OK | os.X_OK):
        raise UserError(f"cannot read the store {store}: name another with --store")
    return store.absolute()


if __name__ == "__main__":
    raise SystemExit(main())
