"""The progress of a sweep: a live table on a terminal, lines elsewhere."""

from math import inf
from time import monotonic
from typing import Any, TextIO

from rich.console import Group
from rich.table import Table
from rich.text import Text

from tom import readable
from tom.cli.screen import Screen, Shown
from tom.harmless import terminal
from tom.record import RunReader
from tom.sweep.driver import Driver, Job

LINE_EVERY_S = 30.0
ORDER = ("running", "elsewhere", "failed", "stopped", "waiting", "finished")
COLUMNS = ("run", "state", "step", "of", "last return", "best return", "steps/s", "left", "note")


def job_row(driver: Driver, job: Job) -> dict[str, Any]:
    """The state of one training, for scripts."""
    status = RunReader(driver.store.path / job.run_id).status
    return {
        "run_id": job.run_id,
        "env": job.trial.env,
        "learner": job.trial.learner,
        "seed": job.trial.seed,
        "state": job.state,
        "env_step": status.env_step,
        "last_return": status.last_return,
        "best_return": status.best_return,
        "note": job.note,
    }


class Watcher(Shown):
    """Shows the progress of a sweep; `look` may be called at any rate."""

    def __init__(self, driver: Driver, stream: TextIO) -> None:
        self._driver = driver
        self._screen = Screen(stream, self._picture, self._summary, LINE_EVERY_S, -inf)
        self._states: dict[str, str] = {}

    def look(self) -> None:
        """Update the display."""
        changed = self._changed()
        if not self._screen.live:
            for job in changed:
                note = f" ({job.note.splitlines()[0]})" if job.note else ""
                self._screen.print(terminal(f"{job.run_id}: {job.state}{note}"))
        self._screen.look(monotonic(), now=self._screen.live and bool(changed))

    def _changed(self) -> list[Job]:
        """The trainings whose state has changed since the last call of `look`."""
        new = [s for s in self._driver.jobs if self._states.get(s.trial.run_id) != s.state]
        self._states |= {job.trial.run_id: job.state for job in new}
        return new

    def _summary(self) -> str:
        states = [job.state for job in self._driver.jobs]
        parts = [f"{states.count(name)} {name}" for name in ORDER if name in states]
        full = "; the disk is full: waiting for room" if self._driver.full else ""
        trouble = f"; {self._driver.trouble}" if self._driver.trouble else ""
        return ", ".join(parts) + full + trouble

    def _picture(self) -> Group:
        """A table of as many runs as the terminal has lines for, the most important first."""
        table = Table(title_justify="left")
        for column in COLUMNS:
            left = column in ("run", "state", "note")
            table.add_column(column, justify="left" if left else "right", no_wrap=column != "note")
        jobs = sorted(self._driver.jobs, key=lambda job: ORDER.index(job.state))
        room = self._screen.rows
        for job in jobs[:room]:
            table.add_row(*(Text(terminal(cell)) for cell in self._cells(job)))
        more = f", {len(jobs) - room} more not shown" if len(jobs) > room else ""
        return Group(table, Text(self._summary() + more))

    def _cells(self, job: Job) -> tuple[str, ...]:
        note = job.note.splitlines()[0][:60] if job.note else ""
        if job.state == "waiting":
            steps = str(job.trial.config.total_steps)
            return (job.run_id, job.state, "", steps, "", "", "", "", note)
        status = RunReader(self._driver.store.path / job.run_id).status
        return (
            job.run_id,
            status.phase if job.state == "running" and status.phase else job.state,
            str(status.env_step),
            str(status.total),
            readable.score(status.last_return),
            readable.score(status.best_return),
            readable.number(status.env_steps_per_s),
            readable.duration(status.eta_s) if job.state in ("running", "elsewhere") else "",
            note,
        )
