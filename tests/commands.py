"""Commands of `tom` in this process."""

from collections.abc import Sequence

from tom.cli import main


def code_of(words: Sequence[str]) -> int:
    """The exit code of `tom` with these words, also if its parser ends it."""
    try:
        return main(words)
    except SystemExit as stop:
        return int(str(stop.code))
