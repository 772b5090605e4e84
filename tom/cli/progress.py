"""Progress of a run on a terminal (a bar) or elsewhere (plain lines, at least one each 30 s)."""

from collections import deque
from time import monotonic
from typing import TextIO

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from tom.events import Evaluation, Event, Notice, Tick

LINE_EVERY_S = 20.0


class Pace:
    """Env steps a second of late, whatever step a run began at."""

    def __init__(self) -> None:
        self.step = 0
        self._recent: deque[tuple[float, int]] = deque(maxlen=200)  # (when, step)

    def reach(self, step: int, now: float) -> None:
        self.step = max(self.step, step)
        if not self._recent or now - self._recent[-1][0] > 0.2:
            self._recent.append((now, self.step))

    def rate(self) -> float:
        """0 where that is not known yet."""
        if not self._recent:
            return 0.0
        (t0, s0), (t1, s1) = self._recent[0], self._recent[-1]
        return (s1 - s0) / (t1 - t0) if t1 > t0 else 0.0

    def rate_text(self) -> str:
        return f"{self.rate():.0f} steps/s" if self.rate() else ""

    def eta_text(self, total: int) -> str:
        left, rate = total - self.step, self.rate()
        return f"eta {left / rate:.0f} s" if rate > 0 and left > 0 else ""


class ProgressReport:
    """Shows phase, env steps/s, last and best return and the time to go."""

    def __init__(self, label: str, total: int, stream: TextIO) -> None:
        self._label, self._total, self._stream = label, total, stream
        self._console = StoppableConsole(file=stream)
        self._bar = _bar(self._console) if self._console.is_terminal else None
        self._task = self._bar.add_task(label, total=total, text="") if self._bar else None
        self._pace = Pace()
        self._shown = monotonic()
        self._phase = ""
        self._last: float | None = None
        self._best: float | None = None

    def __enter__(self) -> "ProgressReport":
        if self._bar:
            self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar:
            self._bar.stop()

    def consume(self, event: Event) -> None:
        if isinstance(event, Evaluation):
            self._last = event.mean_return
            self._best = self._last if self._best is None else max(self._best, self._last)
        elif isinstance(event, Notice):
            self._console.print(
                f"{self._label} step {event.env_step}: {event.message}", markup=False
            )
        elif isinstance(event, Tick):
            self._tick(event)

    def _tick(self, event: Tick) -> None:
        now = monotonic()
        self._pace.reach(event.env_step, now)
        self._phase = event.phase
        if self._bar and self._task is not None:
            self._bar.update(self._task, completed=event.env_step, text=self._text())
        elif now - self._shown > LINE_EVERY_S or event.env_step == self._total:
            self._shown = now
            at = f"{self._label} {event.env_step}/{self._total}"
            line = joined(at, self._text(), self._pace.eta_text(self._total))
            print(line, file=self._stream, flush=True)

    def _text(self) -> str:
        returns = "" if self._last is None else f"return {self._last:.1f} best {self._best:.1f}"
        return joined(self._phase, self._pace.rate_text(), returns)


def joined(*parts: str) -> str:
    """What there is to say, as one line."""
    return " ".join(part for part in parts if part)


class StoppableConsole(Console):
    def on_broken_pipe(self) -> None:
        """Rich would end the process here; whoever trains decides instead."""
        raise BrokenPipeError


def _bar(console: Console) -> Progress:
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[text]}"),
        TimeRemainingColumn(),
        console=console,
    )
