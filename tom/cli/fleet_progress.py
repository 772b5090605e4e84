"""Progress of a fleet: a live table of its members on a terminal, lines elsewhere."""

from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from statistics import mean
from time import monotonic
from typing import TextIO

from rich.console import Group
from rich.table import Table
from rich.text import Text

from tom.cli.progress import LINE_EVERY_S, Pace, joined
from tom.cli.screen import Screen, Shown
from tom.events import Evaluation, Event, Notice, Tick
from tom.training.plan import Trial

COLUMNS = ("run", "phase", "step", "last return", "best return")


@dataclass
class _Member:
    """The progress of one training."""

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


class FleetReport(Shown):
    """Shows every member's phase, step and returns, and the fleet's speed and remaining time."""

    def __init__(self, trials: Sequence[Trial], stream: TextIO) -> None:
        self.label = f"{trials[0].env}, {len(trials)} in a fleet"
        self._total = max(trial.config.total_steps for trial in trials)
        self._members = [_Member(trial) for trial in trials]
        self._screen = Screen(stream, self._table, self._line, LINE_EVERY_S, monotonic())
        self._pace = Pace()

    def watchers(self) -> list[Callable[[Event], None]]:
        """A function for each member, in order, that takes its events."""
        return [self._watcher(member) for member in self._members]

    def _watcher(self, member: _Member) -> Callable[[Event], None]:
        def consume(event: Event) -> None:
            member.consume(event)
            if isinstance(event, Notice):
                line = f"{member.trial.run_id} step {event.env_step}: {event.message}"
                self._screen.say(line)
            elif isinstance(event, Tick):
                self._tick(event.env_step)

        return consume

    def _tick(self, step: int) -> None:
        ended = self._pace.step < step == self._total
        at = monotonic()
        self._pace.reach(step, at)
        self._screen.look(at, now=ended)

    def _line(self) -> str:
        at = f"{self.label} {self._pace.step}/{self._total}"
        pace = self._pace
        return joined(at, pace.rate_text(), self._means(), pace.eta_text(self._total))

    def _means(self) -> str:
        """The mean last return of each learner's members; empty before the first evaluation."""
        returns: dict[str, list[float]] = defaultdict(list)
        for member in self._members:
            if member.last is not None:
                returns[member.trial.learner].append(member.last)
        shown = ", ".join(f"{learner} {mean(values):.1f}" for learner, values in returns.items())
        return f"mean return: {shown}" if shown else ""

    def _table(self) -> Group:
        """A table of as many members as the terminal has lines for."""
        table = Table()
        for column in COLUMNS:
            left = column in ("run", "phase")
            table.add_column(column, justify="left" if left else "right", no_wrap=True)
        room = self._screen.rows
        for member in self._members[:room]:
            returns = ("" if v is None else f"{v:.1f}" for v in (member.last, member.best))
            table.add_row(member.trial.run_id, member.phase, str(member.step), *returns)
        more = len(self._members) - room
        return Group(table, Text(self._line() + (f"; {more} more not shown" if more > 0 else "")))
