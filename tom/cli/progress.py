"""Progress of a long command: a picture that is redrawn on a terminal, plain lines elsewhere."""

import shlex
import sys
from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from time import monotonic
from typing import Self, TextIO

from rich.console import Console, RenderableType
from rich.live import Live
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from tom.events import Evaluation, Event, Notice, Tick
from tom.harmless import terminal
from tom.machine.processes import on_stopping
from tom.readable import duration, score
from tom.training.run import AnyConfig, RecordingOptions, Stop

PICTURE_EVERY_S = 1.0
RATE_OVER_S = 300.0
"""the rate of steps is a mean over the last 1000 samples, and at most over this time"""


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


class BarDisplay(Display):
    """A bar of `total` steps."""

    def __init__(self, label: str, total: int, stream: TextIO) -> None:
        super().__init__(stream)
        self.label, self.total = label, total
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
        self.task = self._bar.tasks[0]

    def picture(self) -> Progress:
        return self._bar


class ProgressReport(BarDisplay):
    """A training's phase, env steps/s, last and best return and remaining time."""

    def __init__(self, label: str, total: int, stream: TextIO) -> None:
        super().__init__(label, total, stream)
        self._phase, self._returns = "", list[float]()

    def consume(self, event: Event) -> None:
        if isinstance(event, Evaluation):
            self._returns.append(event.mean_return)
        elif isinstance(event, Notice):
            line = f"{self.label} step {event.env_step}: {event.message}"
            print(terminal(line), file=sys.stderr)  # above the picture, which takes it over
        elif isinstance(event, Tick):
            self._phase = event.phase
            self._bar.update(self.task.id, completed=event.env_step, text=self._text())
            self.refresh(now=event.env_step == self.total)

    def line(self) -> str:
        left = self.task.time_remaining
        eta = f" eta {duration(left)}" if left else ""
        return f"{self.label} {self.task.completed:.0f}/{self.total} {self._text()}{eta}"

    def _text(self) -> str:
        parts = [self._phase]
        if self.task.speed:
            parts.append(f"{self.task.speed:.0f} steps/s")
        if self._returns:
            parts.append(f"return {score(self._returns[-1])} best {score(max(self._returns))}")
        return " ".join(filter(None, parts))


@contextmanager
def followed(
    config: AnyConfig, stream: TextIO, *, rerun: bool
) -> Iterator[tuple[str, RecordingOptions]]:
    """Progress of a training inside the block, which a signal stops cleanly.

    Gives its label, and the options for `train` and `resume`.
    """
    label, stop = f"{config.env} {config.learner} seed {config.seed}", Stop()
    with on_stopping(stop), ProgressReport(label, config.total_steps, stream) as progress:
        command = shlex.join(["tom", *sys.argv[1:]])
        watchers = (progress.consume,)
        yield label, {"rerun": rerun, "watchers": watchers, "command": command, "stop": stop}


class CountReport(BarDisplay):
    """How many of `total` steps are done."""

    def step(self) -> None:
        """Count one more step."""
        self._bar.advance(self.task.id)
        self.refresh()

    def line(self) -> str:
        return f"{self.label}: {self.task.completed:.0f} of {self.total} steps"
