"""What commands print: tables, and the progress of long work.

Tables are as wide as the terminal; elsewhere they are Markdown, a line a row. Progress is a picture
that is redrawn on a terminal, and plain lines elsewhere.
"""

import json
import sys
from abc import ABC, abstractmethod
from argparse import Namespace
from collections.abc import Callable, Iterable, Mapping, Sequence
from time import monotonic
from typing import Any, Self, TextIO

from rich.box import HEAVY_HEAD, MARKDOWN
from rich.console import Console, RenderableType
from rich.live import Live
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text

from tom import readable
from tom.events import Evaluation, Event, Notice, Tick
from tom.harmless import is_number, terminal
from tom.record import RunReader, Store
from tom.record.files import plain

WIDTH = 1000  # in a file or a pipe, where a row is one line
PICTURE_EVERY_S = 1.0
RATE_OVER_S = 300.0
"""the rate of steps is a mean over the last 1000 samples, and at most over this time"""


def show(title: str, columns: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """Print a table; columns of numbers are aligned to the right."""
    listed = [list(row) for row in rows]
    on_terminal = Console().is_terminal
    table = Table(box=HEAVY_HEAD if on_terminal else MARKDOWN)
    for i, column in enumerate(columns):
        known = [row[i].replace(",", "") for row in listed if row[i] != readable.UNKNOWN]
        numeric = bool(listed) and all(map(is_number, known))
        table.add_column(terminal(column), justify="right" if numeric else "left", overflow="fold")
    for row in listed:
        # Text objects, because Rich would read brackets in strings as markup.
        table.add_row(*(Text("\n".join(map(terminal, cell.split("\n")))) for cell in row))
    console = Console(width=None if on_terminal else WIDTH)
    # The table's own title would be wrapped to the width of the table.
    console.print(Text(terminal(title), style="italic"))
    console.print(table)


def show_rows(title: str, rows: Sequence[Mapping[str, Any]]) -> None:
    """Print a table whose columns are the keys of its rows, all with the same keys."""
    show(title, list(rows[0]), [list(map(readable.cell, row.values())) for row in rows])


def print_result(
    args: Namespace, content: object, shown: Iterable[str] | Callable[[], object]
) -> int:
    """Print `content` as JSON if that is asked for, else the lines `shown`, or by it; returns 0."""
    if args.json:
        print(json.dumps(plain(content), allow_nan=False))
    elif callable(shown):
        shown()
    else:
        for line in shown:
            print(terminal(line))
    return 0


def print_problems(store: Store) -> None:
    """Print on stderr what `store.runs()` left out."""
    for problem in store.problems:
        print(terminal(problem), file=sys.stderr)


def summary(run: RunReader) -> dict[str, Any]:
    """A run's last and best return and its folder."""
    status = run.status
    return {
        "run_id": run.run_id,
        "env": run.env,
        "learner": run.learner,
        "seed": run.seed,
        "state": status.state,
        "env_step": status.env_step,
        "last_return": status.last_return,
        "best_return": status.best_return,
        "path": str(run.path),
    }


# Progress


class StoppableConsole(Console):
    def on_broken_pipe(self) -> None:
        """Rich would end the process here; the training decides instead."""
        raise BrokenPipeError


class Display(ABC):
    """A `picture` on a terminal, or every `line_every_s` seconds a `line` elsewhere.

    It is shown inside a `with` block. `refresh` may be called at any rate.
    """

    line_every_s = 20.0

    def __init__(self, stream: TextIO) -> None:
        self.console = StoppableConsole(file=stream)
        terminal = self.console.is_terminal
        self.live = Live(console=self.console, auto_refresh=False) if terminal else None
        self._shown = monotonic()

    @abstractmethod
    def picture(self) -> RenderableType:
        """What a terminal shows now."""

    @abstractmethod
    def line(self) -> str:
        """The same in a line."""

    def __enter__(self) -> Self:
        if self.live:
            self.live.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self.live:
            self.live.update(self.picture(), refresh=True)
            self.live.stop()

    def refresh(self, *, now: bool = False) -> None:
        """Show the progress, unless it was shown a moment ago and `now` is false."""
        at, every_s = monotonic(), PICTURE_EVERY_S if self.live else self.line_every_s
        if not now and at - self._shown < every_s:
            return
        self._shown = at
        if self.live:
            self.live.update(self.picture(), refresh=True)
        else:
            self.print(self.line())

    def print(self, line: str) -> None:
        """Print a line that stays, above the picture."""
        self.console.print(line, markup=False, emoji=False, highlight=False, soft_wrap=True)


class ProgressReport(Display):
    """A bar of `total` steps, with what is done now, its speed and the remaining time."""

    def __init__(
        self, label: str, total: int, stream: TextIO, returns: Iterable[float] = ()
    ) -> None:
        """`returns` of the run before it was resumed, the best and the last."""
        super().__init__(stream)
        self.label, self.total = label, total
        self._returns = list(returns)
        self._bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[text]}"),
            TimeRemainingColumn(),
            get_time=lambda: monotonic(),
            speed_estimate_period=RATE_OVER_S,
        )
        self._bar.add_task(label, total=total, text="")
        self._task = self._bar.tasks[0]

    def picture(self) -> Progress:
        return self._bar

    def line(self) -> str:
        left, text = self._task.time_remaining, self._task.fields["text"]
        eta = f"eta {readable.duration(left)}" if left else ""
        done = f"{self._task.completed:.0f}/{self.total}"
        return " ".join(filter(None, (self.label, done, text, eta)))

    def step(self) -> None:
        self._bar.advance(self._task.id)
        self.refresh()

    def consume(self, event: Event) -> None:
        if isinstance(event, Evaluation):
            self._returns.append(event.mean_return)
        elif isinstance(event, Notice):
            line = f"{self.label} step {event.env_step}: {event.message}"
            print(terminal(line), file=sys.stderr)  # above the picture, which takes it over
        elif isinstance(event, Tick):
            self._bar.update(self._task.id, completed=event.env_step)
            parts = [event.phase]
            if self._task.speed:
                parts.append(f"{self._task.speed:.0f} steps/s")
            if self._returns:
                last, best = self._returns[-1], max(self._returns)
                parts.append(f"return {readable.score(last)} best {readable.score(best)}")
            self._bar.update(self._task.id, text=" ".join(filter(None, parts)))
            self.refresh(now=event.env_step == self.total)
