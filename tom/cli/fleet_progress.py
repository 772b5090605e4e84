"""Progress of a fleet: a live table of its members on a terminal, lines elsewhere."""

from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from statistics import mean
from time import monotonic
from typing import TextIO

from rich.console import Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from tom.cli.progress import LINE_EVERY_S, Pace, StoppableConsole, joined
from tom.events import Evaluation, Event, Notice, Tick
from tom.training.plan import Trial

LOOK_EVERY_S = 1.0
COLUMNS = ("run", "phase", "step", "last return", "best return")


@dataclass
class _Member:
    """Where one training stands."""

    trial: Trial
    phase: str = "waiting"
    step: int = 0
    last: float | None = None
    best: float | None = None

    def consume(self, event: Event) -> None:
        if isinstance(event, Evaluation):
            self.last = event.mean_return
            self.best = self.last if self.best is None else max(self.best, self.last)
        elif isinstance(event, Tick):
            self.phase, self.step = event.phase, event.env_step


class FleetReport:
    """Shows every member's phase, step and returns, and the pace and the time to go of all."""

    def __init__(self, trials: Sequence[Trial], stream: TextIO) -> None:
        self.label = f"{trials[0].env}, {len(trials)} in a fleet"
        self._total = max(trial.config.total_steps for trial in trials)
        self._members = [_Member(trial) for trial in trials]
        self._console = StoppableConsole(file=stream)
        live = self._console.is_terminal
        self._live = Live(console=self._console, auto_refresh=False) if live else None
        self._pace = Pace()
        self._shown = monotonic()

    def __enter__(self) -> "FleetReport":
        if self._live:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._live:
            self._live.update(self._table(), refresh=True)
            self._live.stop()

    def watchers(self) -> list[Callable[[Event], None]]:
        """What each member's events go to, in member order."""
        return [self._watcher(member) for member in self._members]

    def _watcher(self, member: _Member) -> Callable[[Event], None]:
        def consume(event: Event) -> None:
            member.consume(event)
            if isinstance(event, Notice):
                line = f"{member.trial.run_id} step {event.env_step}: {event.message}"
                self._console.print(line, markup=False)
            elif isinstance(event, Tick):
                self._tick(event.env_step)

        return consume

    def _tick(self, step: int) -> None:
        now, ended = monotonic(), self._pace.step < step == self._total
        self._pace.reach(step, now)
        if self._live:
            if now - self._shown >= LOOK_EVERY_S:
                self._shown = now
                self._live.update(self._table(), refresh=True)
        elif now - self._shown > LINE_EVERY_S or ended:
            self._shown = now
            print(self._line(), file=self._console.file, flush=True)

    def _line(self) -> str:
        at = f"{self.label} {self._pace.step}/{self._total}"
        pace = self._pace
        return joined(at, pace.rate_text(), self._means(), pace.eta_text(self._total))

    def _means(self) -> str:
        """The mean of the last returns of each learner's members; nothing before there are any."""
        found: dict[str, list[float]] = defaultdict(list)
        for member in self._members:
            if member.last is not None:
                found[member.trial.learner].append(member.last)
        shown = ", ".join(f"{learner} {mean(values):.1f}" for learner, values in found.items())
        return f"mean return: {shown}" if shown else ""

    def _table(self) -> Group:
        """As many members as the terminal has lines for."""
        table = Table()
        for column in COLUMNS:
            left = column in ("run", "phase")
            table.add_column(column, justify="left" if left else "right", no_wrap=True)
        room = max(self._console.height - 8, 3)
        for member in self._members[:room]:
            returns = ("" if v is None else f"{v:.1f}" for v in (member.last, member.best))
            table.add_row(member.trial.run_id, member.phase, str(member.step), *returns)
        more = len(self._members) - room
        return Group(table, Text(self._line() + (f"; {more} more not shown" if more > 0 else "")))
