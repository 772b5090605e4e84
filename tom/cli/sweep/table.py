"""What a running sweep shows: a live table on a terminal, lines elsewhere."""

from time import monotonic
from typing import Any, TextIO

from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from tom.harmless import terminal
from tom.record import RunReader
from tom.sweep.driver import Driver, Job

LINE_EVERY_S = 30.0
LOOK_EVERY_S = 1.0
ORDER = ("running", "elsewhere", "failed", "stopped", "waiting", "finished")
COLUMNS = ("run", "state", "step", "of", "last return", "best return", "steps/s", "left", "note")


def job_row(driver: Driver, job: Job) -> dict[str, Any]:
    """Where one training stands, for a script."""
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


class Watcher:
    """Shows a sweep as it goes; `look` may be called as often as one likes."""

    def __init__(self, driver: Driver, stream: TextIO) -> None:
        self._driver = driver
        self._console = Console(file=stream)
        live = self._console.is_terminal
        self._live = Live(console=self._console, auto_refresh=False) if live else None
        self._shown = -LINE_EVERY_S
        self._states: dict[str, str] = {}

    def __enter__(self) -> "Watcher":
        if self._live:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._live:
            self._live.stop()

    def say(self, line: str) -> None:
        self._console.print(line, markup=False)

    def look(self) -> None:
        """Show where the sweep stands."""
        if self._live:
            if monotonic() - self._shown >= LOOK_EVERY_S or self._changed():
                self._shown = monotonic()
                self._live.update(self._picture(), refresh=True)
            return
        for job in self._changed():
            note = f" ({job.note.splitlines()[0]})" if job.note else ""
            line = terminal(f"{job.run_id}: {job.state}{note}")
            print(line, file=self._console.file, flush=True)
        if monotonic() - self._shown >= LINE_EVERY_S:
            self._shown = monotonic()
            print(self._summary(), file=self._console.file, flush=True)

    def _changed(self) -> list[Job]:
        """The trainings whose state is another than at the last look."""
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
        """As many runs as the terminal has lines for, those that matter first."""
        table = Table(title_justify="left")
        for column in COLUMNS:
            left = column in ("run", "state", "note")
            table.add_column(column, justify="left" if left else "right", no_wrap=column != "note")
        jobs = sorted(self._driver.jobs, key=lambda job: ORDER.index(job.state))
        room = max(self._console.height - 8, 3)
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
            _number(status.last_return),
            _number(status.best_return),
            _number(status.env_steps_per_s),
            _clock(status.eta_s) if job.state in ("running", "elsewhere") else "",
            note,
        )


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.1f}"


def _clock(seconds: float | None) -> str:
    if seconds is None:
        return ""
    minutes = round(seconds / 60)
    return f"{minutes // 60}:{minutes % 60:02d} h"
