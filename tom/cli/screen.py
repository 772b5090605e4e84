"""Progress display of a long command: a live picture on a terminal, lines elsewhere."""

from collections.abc import Callable
from typing import Self, TextIO

from rich.console import Console, RenderableType
from rich.live import Live

LOOK_EVERY_S = 1.0
FRAME_LINES = 8
"""terminal lines taken by a table's frame, its head and the lines below it"""


class StoppableConsole(Console):
    def on_broken_pipe(self) -> None:
        """Rich would end the process here; the training decides instead."""
        raise BrokenPipeError


class Screen:
    """A `picture` that is redrawn on a terminal, or a `line` from time to time elsewhere.

    Both are functions, called when something is shown. `look` may be called at any rate. Times are
    those of a monotonic clock; `shown` is the time of the last display.
    """

    def __init__(
        self,
        stream: TextIO,
        picture: Callable[[], RenderableType],
        line: Callable[[], str],
        line_every_s: float,
        shown: float,
    ) -> None:
        self._console = StoppableConsole(file=stream)
        self._picture, self._line, self._line_every_s = picture, line, line_every_s
        terminal = self._console.is_terminal
        self._live = Live(console=self._console, auto_refresh=False) if terminal else None
        self._shown = shown

    def __enter__(self) -> "Screen":
        if self._live:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._live:
            self._live.update(self._picture(), refresh=True)
            self._live.stop()

    @property
    def live(self) -> bool:
        """Whether there is a terminal to draw on."""
        return self._live is not None

    @property
    def rows(self) -> int:
        """How many rows of a table the terminal has room for."""
        return max(self._console.height - FRAME_LINES, 3)

    def look(self, at: float, *, now: bool = False) -> None:
        """Update the display, unless the last update was a moment ago and `now` is false."""
        every_s = LOOK_EVERY_S if self._live else self._line_every_s
        if not now and at - self._shown < every_s:
            return
        self._shown = at
        if self._live:
            self._live.update(self._picture(), refresh=True)
        else:
            self.print(self._line())

    def print(self, line: str) -> None:
        """Print a plain line without wrapping, for output that is not a terminal."""
        print(line, file=self._console.file, flush=True)

    def say(self, line: str) -> None:
        """Print a line that stays, above the picture."""
        self._console.print(line, markup=False, emoji=False, highlight=False, soft_wrap=True)


class Shown:
    """A report on a `Screen`, which it shows inside a `with` block."""

    _screen: Screen

    def __enter__(self) -> Self:
        self._screen.__enter__()
        return self

    def __exit__(self, *_: object) -> None:
        self._screen.__exit__()

    def say(self, line: str) -> None:
        """Print a line that stays, above the picture."""
        self._screen.say(line)
