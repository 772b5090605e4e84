"""Progress of a run on a terminal (a bar) or elsewhere (plain lines, at least one each 30 s)."""

from collections import deque
from time import monotonic
from typing import TextIO

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from tom.cli.screen import Screen, Shown
from tom.events import Evaluation, Event, Notice, Tick
from tom.readable import duration, score

LINE_EVERY_S = 20.0


class Pace:
    """Recent env steps per second, whatever step a run began at."""

    def __init__(self) -> None:
        self.step = 0
        self._recent: deque[tuple[float, int]] = deque(maxlen=200)  # (when, step)

    def reach(self, step: int, now: float) -> None:
        self.step = max(self.step, step)
        if not self._recent or now - self._recent[-1][0] > 0.2:
            self._recent.append((now, self.step))

    def rate(self) -> float:
        """Steps per second; 0 if not known yet."""
        if not self._recent:
            return 0.0
        (t0, s0), (t1, s1) = self._recent[0], self._recent[-1]
        return (s1 - s0) / (t1 - t0) if t1 > t0 else 0.0

    def rate_text(self) -> str:
        return f"{self.rate():.0f} steps/s" if self.rate() else ""

    def eta_text(self, total: int) -> str:
        left, rate = total - self.step, self.rate()
        return f"eta {duration(left / rate)}" if rate > 0 and left > 0 else ""


class ProgressReport(Shown):
    """Shows phase, env steps/s, last and best return and the remaining time."""

    def __init__(self, label: str, total: int, stream: TextIO) -> None:
        self._label, self._total = label, total
        self._bar = _bar()
        self._task = self._bar.add_task(label, total=total, text="")
        self._screen = Screen(stream, lambda: self._bar, self._line, LINE_EVERY_S, monotonic())
        self._pace = Pace()
        self._phase = ""
        self._last: float | None = None
        self._best: float | None = None

    def consume(self, event: Event) -> None:
        if isinstance(event, Evaluation):
            self._last = event.mean_return
            self._best = self._last if self._best is None else max(self._best, self._last)
        elif isinstance(event, Notice):
            self._screen.say(f"{self._label} step {event.env_step}: {event.message}")
        elif isinstance(event, Tick):
            self._tick(event)

    def _tick(self, event: Tick) -> None:
        at = monotonic()
        self._pace.reach(event.env_step, at)
        self._phase = event.phase
        self._bar.update(self._task, completed=event.env_step, text=self._text())
        self._screen.look(at, now=event.env_step == self._total)

    def _line(self) -> str:
        at = f"{self._label} {self._pace.step}/{self._total}"
        return joined(at, self._text(), self._pace.eta_text(self._total))

    def _text(self) -> str:
        returns = (
            "" if self._last is None else f"return {score(self._last)} best {score(self._best)}"
        )
        return joined(self._phase, self._pace.rate_text(), returns)


class CountReport(Shown):
    """Shows how many of `total` steps are done: a bar on a terminal, else a line every 20 s."""

    def __init__(self, label: str, total: int, stream: TextIO) -> None:
        self._label, self._total, self._done = label, total, 0
        self._bar = _bar()
        self._task = self._bar.add_task(label, total=total, text="")
        self._screen = Screen(stream, lambda: self._bar, self._line, LINE_EVERY_S, monotonic())

    def step(self) -> None:
        """Count one more step."""
        self._done += 1
        self._bar.update(self._task, completed=self._done)
        self._screen.look(monotonic())

    def _line(self) -> str:
        return f"{self._label}: {self._done} of {self._total} steps"


def joined(*parts: str) -> str:
    """The non-empty parts as one line."""
    return " ".join(part for part in parts if part)


def _bar() -> Progress:
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[text]}"),
        TimeRemainingColumn(),
    )
