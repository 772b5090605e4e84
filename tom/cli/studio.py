"""`tom studio`: hand over to the studio, a package that the backend never imports."""

import os
import sys
from collections.abc import Sequence
from typing import NoReturn


def add_parser(subparsers, arguments: list[str]) -> None:
    subparsers.add_parser("studio")


def hand_over(arguments: Sequence[str], module: str = "app") -> NoReturn:
    """Replace this process by `python -m MODULE` with these arguments."""
    sys.stdout.flush()
    os.execv(sys.executable, [sys.executable, "-m", module, *arguments])
