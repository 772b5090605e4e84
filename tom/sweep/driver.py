"""Runs a sweep: starts trainings, reads their exit codes, and tries again where that may help.

Every training is `tom train --run-id NAME --resume auto`, which may be given again at any time. The
run folders are the only memory: a driver that was killed and is started again sees there which runs
are finished and which another process is writing. Ctrl-C asks the trainings to stop; the kernel
does the same if the driver is killed. The engine decides where the trainings run, the backend where
the runs are stored: a folder, or a bucket of an object store (`bucket`).
"""

import shutil
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from tom import plugins
from tom.errors import BAD_INPUT, FAILED
from tom.record import RunReader, Store, checkpoint, layout, lock
from tom.record.status import DEAD_AFTER_S
from tom.record.versions import ACCEPT
from tom.sweep.engine import Engine, Process
from tom.training.plan import Trial, is_done, same_run

State = Literal["waiting", "running", "elsewhere", "finished", "failed", "stopped"]

ATTEMPTS = 3
"""A training is given up if it ends this many times without getting further."""

BACK_OFF_S = 5.0  # wait before the second attempt; it doubles with each further one
LOW_BYTES = 200e6  # with less free disk space nothing is started and no failure is counted
STOP_S = 300.0  # a training writes its checkpoint within this time after a request
KILL_S = 10.0  # a killed process has ended within this time

Clock = Callable[[], float]
"""gives seconds that never decrease"""


class FolderBackend:
    """The runs of a sweep in a folder that all trainings can write to: `store`.

    Of a bucket, `store` holds the parts of them that a driver needs. Every method raises OSError if
    the runs cannot be reached.

    How long a run that another machine writes is left to it goes by this machine's own `clock`: two
    machines' clocks may differ by any amount, so what counts is when this one saw its status
    change, and that `lease_s` have not passed since.
    """

    lease_s = DEAD_AFTER_S

    def __init__(self, store: Store, clock: Clock = time.monotonic) -> None:
        self.store = store
        self._clock = clock
        self._seen: dict[str, tuple[object, float]] = {}
        """what changes while a run is written (None: nobody claims to write it), and since when"""

    def update(self, run_id: str, *, now: bool = False) -> None:
        """Update the parts of a run in `store`: at once if `now`, else when an update is due.

        The folder itself is read, so it is never out of date.
        """

    def command(self, run_id: str, options: Sequence[str]) -> list[str]:
        """The arguments of `python -m` that start the training `tom train OPTIONS`."""
        return ["tom", "train", *options, "--no-rerun", f"--store={self.store.path.resolve()}"]

    def writer(self, run: RunReader) -> Literal["here", "away"] | None:
        """Whether a process of this machine, or perhaps of another one, is writing the run.

        By the lock, or by another machine's heartbeat that was seen to change a moment ago.
        """
        here = lock.was_written_here(run.path)
        if lock.is_held(run.path):  # a shared file system may also show another machine's lock
            return "away" if here is False else "here"
        status = run.status
        self._note_sign(run.run_id, status if status.state == "running" and here is False else None)
        return "away" if self._is_leased(run.run_id) else None

    def ended(self, run_id: str) -> None:
        """Note that the process that was last started for the run was seen to end.

        In a folder the lock shows it, or on another machine the heartbeat.
        """

    def keep_log(self, log: Path) -> str:
        """Keep the log of a failed training; returns its place after the end of the sweep."""
        return str(log)

    def _note_sign(self, run_id: str, sign: object) -> None:
        if run_id not in self._seen or self._seen[run_id][0] != sign:
            self._seen[run_id] = (sign, self._clock())

    def _is_leased(self, run_id: str) -> bool:
        """Whether the run is to be left to its writer."""
        sign, since = self._seen.get(run_id, (None, 0.0))
        return sign is not None and self._clock() - since < self.lease_s


@dataclass
class Job:
    trial: Trial
    log: Path
    run_id: str
    state: State = "waiting"
    note: str = ""
    attempts: int = 0  # that have not got further
    step: int = -1  # of the newest checkpoint when it was last started
    not_before: float = 0.0
    away: bool = False  # another machine trains it, with a core of its own
    process: Process | None = field(default=None, repr=False)


class Driver:
    """Runs `trials`, whose runs are in `backend`. Call `poll` until it returns True."""

    def __init__(
        self,
        backend: FolderBackend,
        trials: Sequence[Trial],
        engine: Engine,
        low_bytes: float = LOW_BYTES,
        back_off_s: float = BACK_OFF_S,
        accept_versions: bool = False,
    ) -> None:
        """`accept_versions`: resume runs of other versions, although their numbers may differ."""
        self.backend = backend
        self.store = backend.store
        self.engine = engine
        self.low_bytes = low_bytes
        self.back_off_s = back_off_s
        plugged = [f"{plugins.OPTION}={name}" for name in plugins.wanted_here()]
        self._options = ["--resume=auto", *plugged, *([ACCEPT] if accept_versions else [])]
        runs = self.store.runs()
        logs = self.store.beside(layout.LOGS)
        self.jobs: list[Job] = []
        for trial in trials:
            run = same_run(trial, runs)
            run_id = run.run_id if run else trial.run_id
            job = Job(trial, logs / f"{run_id}.log", run_id)
            if run and is_done(trial.config, run):
                job.state, job.note = "finished", "was there already"
            self.jobs.append(job)
        self._order = list(self.jobs)  # in which `poll` checks them
        self.full = False
        self.trouble = ""
        """the reason why the runs cannot be reached at present"""

    def poll(self) -> bool:
        """Check every training once; returns True when there is nothing left to do.

        A training that cannot be reached is not judged, and the round ends there: the backend may
        be down, and then every request takes long. The next poll checks it last. Raises GoneError.
        """
        self.trouble, self.full = "", self._is_full()
        slots = self.engine.slots
        for job in tuple(self._order):
            try:
                self._advance(job, slots)
            except OSError as error:
                self.trouble = str(error)
                self._order.remove(job)
                self._order.append(job)
                break
        return all(job.state in ("finished", "failed", "stopped") for job in self.jobs)

    def stop(self, wait_s: float = STOP_S) -> None:
        """Ask every training to stop, wait for them, and kill those that do not stop in time.

        A KeyboardInterrupt during the wait kills them at once.
        """
        running = [(job, job.process) for job in self.jobs if job.process]
        for _, process in running:
            process.terminate()
        with suppress(KeyboardInterrupt):  # a second request: they keep their last checkpoints
            _wait([process for _, process in running], wait_s)
        for _, process in running:
            process.kill()
        _wait([process for _, process in running], KILL_S)
        for job, process in running:
            if process.poll() is not None:
                with suppress(OSError):  # out of reach: others wait until nothing is seen of it
                    self.backend.ended(job.run_id)
        self.detach()

    def detach(self) -> None:
        """Take the final state of every running training from its run, not from its process."""
        for job in self.jobs:
            if job.process is None:
                continue
            job.process = None
            with suppress(OSError):  # out of reach: its last known state counts
                self.backend.update(job.run_id, now=True)
            job.state = "finished" if self._is_done(job) else "stopped"

    def run_of(self, job: Job) -> RunReader:
        """The run of a training; it may not be there yet."""
        return RunReader(self.store.path / job.run_id)

    def _advance(self, job: Job, slots: int) -> None:
        if job.state in ("running", "elsewhere"):
            self.backend.update(job.run_id)
        if job.process and (code := job.process.poll()) is not None:
            self._ended(job, code)
        elif job.state == "elsewhere":
            if self._is_done(job):
                job.state, job.note = "finished", "by another process"
            elif not self._is_written(job):
                job.state = "waiting"
                if job.attempts:  # it is ours that was the last to write it
                    self._retry(job)
        if job.state != "waiting" or self.full or time.monotonic() < job.not_before:
            return
        written = [one for one in self.jobs if one.state in ("running", "elsewhere")]
        if sum(not one.away for one in written) < slots:
            self._start(job)

    def _start(self, job: Job) -> None:
        self.backend.update(job.run_id, now=True)
        if self._is_done(job):
            job.state, job.note = "finished", "by another process"
            return
        if self._is_written(job):
            job.note = "another process is writing it, or was a moment ago"
            return
        saved = self._checkpoint_step(job)
        if saved < 0 and job.run_id != job.trial.run_id:
            job.run_id = job.trial.run_id  # it cannot go on; what has the own name perhaps can
            self._start(job)
            return
        job.step, job.attempts = saved, job.attempts + 1
        options = [*job.trial.options(), f"--run-id={job.run_id}", *self._options]
        command = self.backend.command(job.run_id, options)
        try:
            job.log.parent.mkdir(parents=True, exist_ok=True)
            with job.log.open("a", errors="backslashreplace") as out:  # a path may be no text
                out.write(f"$ {' '.join(command)}\n")
            job.process = self.engine.start(command, job.log)
            job.state, job.away = "running", False
        except OSError as error:
            job.note = str(error)
            self._retry(job)

    def _ended(self, job: Job, code: int) -> None:
        self.backend.ended(job.run_id)
        self.backend.update(job.run_id, now=True)
        job.process = None
        how = f"exit code {code}" if code >= 0 else f"killed by signal {-code}"
        lines = job.log.read_text(errors="replace").splitlines() if job.log.is_file() else []
        last = next((line for line in reversed(lines) if line.strip()), "$ ")
        job.note = how if last.startswith("$ ") else f"{how}: {last}"  # `$ ` is its command
        if self._is_done(job):
            job.state, job.note = "finished", ""
        elif code in (FAILED, BAD_INPUT) and not self._is_full():
            job.state = "failed"
        elif not self._is_written(job):
            self._retry(job)

    def _retry(self, job: Job) -> None:
        """Try a training again later, or give it up if that has not helped."""
        if self._is_full() or self._checkpoint_step(job) > job.step:
            job.attempts = 0
        job.state = "failed" if job.attempts >= ATTEMPTS else "waiting"
        job.not_before = time.monotonic() + self.back_off_s * 2 ** max(job.attempts - 1, 0)

    def _is_written(self, job: Job) -> bool:
        """Whether a process that is not ours has the run; then the job is left to it."""
        writer = self.backend.writer(self.run_of(job))
        if writer is None:
            return False
        job.state, job.away = "elsewhere", writer == "away"
        return True

    def _is_done(self, job: Job) -> bool:
        return is_done(job.trial.config, self.run_of(job))

    def _is_full(self) -> bool:
        try:
            return shutil.disk_usage(self.store.path).free < self.low_bytes
        except OSError:  # missing or out of reach: the start of a training will show it
            return False

    def _checkpoint_step(self, job: Job) -> int:
        """The step of its newest checkpoint; -1 if it has none."""
        at = checkpoint.newest(self.store.path / job.run_id / checkpoint.FOLDER)
        return -1 if at is None else at


def _wait(processes: Sequence[Process], wait_s: float) -> None:
    """Wait until all have ended, or for `wait_s` seconds."""
    until = time.monotonic() + wait_s
    while any(process.poll() is None for process in processes) and time.monotonic() < until:
        time.sleep(0.1)
