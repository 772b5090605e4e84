"""Runs a sweep: starts trainings, judges them by their run folders, and starts them again.

The run folders are the only memory: a driver that is killed and started again finds what is done,
what can go on, and what another process is writing. Ctrl-C asks the trainings to stop; the kernel
does the same when the driver itself is killed. Where the trainings run is the engine's business,
where the runs lie is the backend's.
"""

import shutil
import signal
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from tom import plugins
from tom.errors import UserError
from tom.record import RunReader, checkpoint
from tom.record.versions import ACCEPT
from tom.sweep.backend import LOGS, Backend
from tom.sweep.engine import Engine, Exit, Process, lives
from tom.sweep.watchdog import lost
from tom.training.plan import Trial, same_run

State = Literal["waiting", "running", "elsewhere", "finished", "failed", "stopped"]

ATTEMPTS = 3
"""A training that ends so often without getting further is given up."""

BACK_OFF_S = 5.0  # before the second attempt; doubled for each more
LOW_BYTES = 200e6  # with less room on the disk nothing is started, and no failure is counted
KILL_AFTER_S = 300.0  # a training writes its checkpoint within this once it is asked to stop
TAIL_LINES = 5


@dataclass
class Job:
    """Where one training of the sweep stands."""

    trial: Trial
    log: Path
    run_id: str
    state: State = "waiting"
    attempts: int = 0
    step: int = -1  # of the newest checkpoint when it was last started
    not_before: float = 0.0
    anew: bool = False  # what it has cannot be taken up
    note: str = ""
    process: Process | None = field(default=None, repr=False)


class Driver:
    """Runs `trials` whose runs lie in `backend`. Call `poll` until it says that all is done."""

    def __init__(
        self,
        backend: Backend,
        trials: Sequence[Trial],
        engine: Engine,
        low_bytes: float = LOW_BYTES,
        back_off_s: float = BACK_OFF_S,
        accept_versions: bool = False,
    ) -> None:
        """`accept_versions`: runs of other versions go on, with other numbers."""
        self.backend = backend
        self.store = backend.store
        self.engine = engine
        self.low_bytes = low_bytes
        self.back_off_s = back_off_s
        self._accepted = [ACCEPT] if accept_versions else []
        runs = self.store.runs()
        logs = self.store.path / LOGS
        self.jobs: list[Job] = []
        for trial in trials:
            run = same_run(trial, runs)
            run_id = run.run_id if run else trial.run_id
            job = Job(trial, logs / f"{run_id}.log", run_id)
            if run and run.status.state == "finished":
                copy = "a small copy, " if run.small_copy else ""
                job.state, job.note = "finished", f"{copy}was there already"
            self.jobs.append(job)
        self._order = list(self.jobs)
        """in which they are looked after"""
        self.full = False
        self.trouble = ""
        """why the runs cannot be reached at present"""

    def poll(self) -> bool:
        """Look after every training once; True when there is nothing left to do.

        One out of reach is not judged, and ends the round: its backend may be down, and then
        every question takes its time. The others come before it in the next poll. Raises GoneError.
        """
        self.trouble = ""
        for job in tuple(self._order):
            if not self._reached(self._attend, job):
                break
        self._start_some()
        return all(job.state in ("finished", "failed", "stopped") for job in self.jobs)

    def stop(self, wait_s: float = KILL_AFTER_S) -> None:
        """Ask every training to stop and wait for them; those that do not are killed.

        KeyboardInterrupt while it waits kills them at once.
        """
        running = [(job, job.process) for job in self.jobs if job.process]
        for _, process in running:
            process.signal(signal.SIGTERM)
        until = time.monotonic() + wait_s
        with suppress(KeyboardInterrupt):  # asked twice: the checkpoints they have must do
            while time.monotonic() < until and any(lives(process) for _, process in running):
                time.sleep(0.1)
        for _, process in running:
            process.end()
        self.let_go()

    def let_go(self) -> None:
        """Judge every training that was running by what its run says now; none is asked."""
        for job in self.jobs:
            if job.process is None:
                continue
            job.process = None
            with suppress(OSError):  # out of reach: what was last seen of it must do
                self.backend.look(job.run_id, now=True)
            finished = self._reader(job).status.state == "finished"
            job.state = "finished" if finished else "stopped"

    def _reached(self, look: Callable[[Job], None], job: Job) -> bool:
        """Do `look`; False where the training cannot be reached: it is the last one from now on."""
        try:
            look(job)
        except OSError as error:
            self.trouble = str(error)
            self._order.remove(job)
            self._order.append(job)
            return False
        return True

    def _attend(self, job: Job) -> None:
        """Look after one training."""
        if job.state not in ("running", "elsewhere"):
            return
        self.backend.look(job.run_id)
        if job.process is None:
            self._watch(job)
            return
        ended = job.process.poll() or lost(job.process.silent_s(), self._reader(job).status)
        if ended is not None:
            self.backend.look(job.run_id, now=True)
            job.process.end()
            job.process = None
            self._ended(job, ended)

    def _start_some(self) -> None:
        with suppress(OSError):  # not there yet, or out of reach: a start will find out
            self.full = shutil.disk_usage(self.store.path).free < self.low_bytes
        busy = sum(job.state in ("running", "elsewhere") for job in self.jobs)
        slots = self.engine.slots
        now = time.monotonic()
        due = [s for s in self._order if s.state == "waiting" and now >= s.not_before]
        for job in due:
            if busy >= slots or self.full or not self._reached(self._start, job):
                return
            busy += 1

    def _start(self, job: Job) -> None:
        self.backend.look(job.run_id, now=True)
        run = self._reader(job)
        if run.status.state == "finished":
            job.state, job.note = "finished", "by another process"
            return
        if self.backend.written(run):
            job.state, job.note = "elsewhere", "another process is writing it"
            return
        at = checkpoint.newest(run.path / checkpoint.FOLDER)
        if job.attempts and at is not None and at > job.step:
            job.attempts = 0  # it got further: this is not what always fails
        job.attempts += 1
        job.step = -1 if at is None else at
        try:
            words = self.backend.words(job.run_id, self._words(job, at))
            job.process = self._spawn(words, job.log)
            job.state = "running"
        except (UserError, OSError) as error:
            self._judge(job, str(error), hopeless=isinstance(error, UserError))

    def _words(self, job: Job, at: int | None) -> list[str]:
        """The words of `tom train` that take a training up, or begin it."""
        named = [f"{plugins.OPTION}={word}" for word in plugins.wanted_here()]
        if at is not None and not job.anew:
            return [f"--resume={job.run_id}", *job.trial.code(), *named, *self._accepted]
        job.run_id, job.anew = job.trial.run_id, False
        if (self.store.path / job.run_id).is_dir():  # nothing in it to go on from
            where = self.backend.begin_anew(job.run_id)
            job.note = f"began anew; what was there is in {where}"
        return [*job.trial.options(), f"--run-id={job.run_id}", *named, *self._accepted]

    def _spawn(self, words: Sequence[str], log: Path) -> Process:
        log.parent.mkdir(parents=True, exist_ok=True)
        with log.open("a") as out:
            out.write(f"$ {' '.join(words)}\n")
        return self.engine.start(words, log)

    def _ended(self, job: Job, ended: Exit) -> None:
        run = self._reader(job)
        if run.status.state == "finished":  # also where nobody saw its process end
            job.state, job.note = "finished", ""
        elif self.backend.written(run):
            job.state, job.note = "elsewhere", "another process is writing it"
        else:
            why = ended.why or run.status.reason or f"exit code {ended.code}"
            said = _tail(job.log)
            # What only waits for a word is not begun anew: it may be hours of training.
            job.anew = ended.code == 2 and job.step >= 0 and ACCEPT not in said
            refused = ended.code == 2 and not job.anew
            self._judge(job, f"{why}\n{said}", refused)

    def _judge(self, job: Job, why: str, hopeless: bool) -> None:
        """It ended before its time: once more, later, or never again."""
        job.note = why.strip()
        full = shutil.disk_usage(self.store.path).free < self.low_bytes
        if full:
            job.attempts -= 1  # no fault of its own, also where it was refused: it waits for room
        given_up = not full and (hopeless or job.attempts >= ATTEMPTS)
        job.state = "failed" if given_up else "waiting"
        job.not_before = time.monotonic() + self.back_off_s * 2 ** max(job.attempts - 1, 0)

    def _watch(self, job: Job) -> None:
        run = self._reader(job)
        if run.status.state == "finished":
            job.state, job.note = "finished", "by another process"
        elif not self.backend.written(run) and not run.status.alive:
            job.state, job.note = "waiting", ""

    def _reader(self, job: Job) -> RunReader:
        return RunReader(self.store.path / job.run_id)


def _tail(log: Path) -> str:
    try:
        lines = log.read_text(errors="replace").splitlines()
    except OSError:
        return ""
    return "\n".join(line for line in lines[-TAIL_LINES:] if not line.startswith("$ "))
