"""Runs a sweep: starts trainings, reads their state from the run folders, and restarts them.

The run folders are the only memory: a driver that was killed and is started again sees there which
runs are finished, which can be resumed, and which another process is writing. Ctrl-C asks the
trainings to stop; the kernel does the same if the driver is killed. The engine decides where the
trainings run, the backend where the runs are stored.
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
from tom.errors import NOT_NOW, START_AGAIN, UserError
from tom.record import RunReader, checkpoint, layout, lock
from tom.record.creating import TAKEN
from tom.record.lock import BusyError
from tom.record.versions import ACCEPT
from tom.sweep.backend import Backend
from tom.sweep.engine import Engine, Exit, Process, lives
from tom.sweep.watchdog import lost
from tom.training.plan import Trial, given_fewer, given_more, is_done, same_run

State = Literal["waiting", "running", "elsewhere", "finished", "failed", "stopped"]

ATTEMPTS = 3
"""A training is given up if it ends this many times without getting further."""

BACK_OFF_S = 5.0  # wait before the second attempt; it doubles with each further one
LOW_BYTES = 200e6  # with less free disk space nothing is started and no failure is counted
KILL_AFTER_S = 300.0  # a training writes its checkpoint within this time after a request
TAIL_LINES = 5
ELSEWHERE = "another process is writing it, or was a moment ago"


@dataclass
class Job:
    """The state of one training of the sweep."""

    trial: Trial
    log: Path
    run_id: str
    state: State = "waiting"
    attempts: int = 0
    step: int = -1  # of the newest checkpoint when it was last started
    not_before: float = 0.0
    anew: bool = False  # its checkpoints cannot be resumed
    note: str = ""
    ended: str = ""  # why its last process ended, if that is not judged yet
    process: Process | None = field(default=None, repr=False)


class Driver:
    """Runs `trials`, whose runs are in `backend`. Call `poll` until it returns True."""

    def __init__(
        self,
        backend: Backend,
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
        self._accepted = [ACCEPT] if accept_versions else []
        runs = self.store.runs()
        logs = self.store.beside(layout.LOGS)
        self.jobs: list[Job] = []
        for trial in trials:
            run = same_run(trial, runs)
            run_id = run.run_id if run else trial.run_id
            job = Job(trial, logs / f"{run_id}.log", run_id)
            if run and is_done(trial, run):
                copy = "a small copy, " if run.small_copy else ""
                longer = f", and was given {run.config['config']['steps']} steps"
                job.state = "finished"
                job.note = f"{copy}was there already{longer if given_more(trial, run) else ''}"
            self.jobs.append(job)
        self._order = list(self.jobs)
        """the order in which `poll` checks them"""
        self.full = False
        self.trouble = ""
        """the reason why the runs cannot be reached at present"""

    def poll(self) -> bool:
        """Check every training once; returns True when there is nothing left to do.

        A training that cannot be reached is not judged, and the round ends there: the backend may
        be down, and then every request takes long. The next poll checks it last. Raises GoneError.
        """
        self.trouble = ""
        for job in tuple(self._order):
            if not self._reached(self._attend, job):
                break
        self._start_some()
        return all(job.state in ("finished", "failed", "stopped") for job in self.jobs)

    def stop(self, wait_s: float = KILL_AFTER_S) -> None:
        """Ask every training to stop, wait for them, and kill those that do not stop in time.

        A KeyboardInterrupt during the wait kills them at once.
        """
        running = [(job, job.process) for job in self.jobs if job.process]
        for _, process in running:
            process.signal(signal.SIGTERM)
        until = time.monotonic() + wait_s
        with suppress(KeyboardInterrupt):  # a second request: they keep their last checkpoints
            while time.monotonic() < until and any(lives(process) for _, process in running):
                time.sleep(0.1)
        for _, process in running:
            process.end()
        for job, process in running:
            with suppress(OSError):  # out of reach: others wait until nothing more is seen of it
                self._tell(job, process.poll())
        self.let_go()

    def let_go(self) -> None:
        """Take the final state of every running training from its run, not from its process."""
        for job in self.jobs:
            if job.process is None:
                continue
            job.process = None
            with suppress(OSError):  # out of reach: its last known state counts
                self.backend.look(job.run_id, now=True)
            job.state = "finished" if is_done(job.trial, self._reader(job)) else "stopped"

    def _reached(self, look: Callable[[Job], None], job: Job) -> bool:
        """Call `look`; False if the training cannot be reached, which is then checked last."""
        try:
            look(job)
        except OSError as error:
            self.trouble = str(error)
            self._order.remove(job)
            self._order.append(job)
            return False
        return True

    def _attend(self, job: Job) -> None:
        """Check one training."""
        if job.state not in ("running", "elsewhere"):
            return
        self.backend.look(job.run_id)
        if job.process is None:
            self._watch(job)
            return
        ended = job.process.poll() or lost(job.process.silent_s(), self._reader(job).status)
        if ended is not None:
            self._tell(job, ended)
            self.backend.look(job.run_id, now=True)
            job.process.end()
            job.process = None
            self._ended(job, ended)

    def _tell(self, job: Job, ended: Exit | None) -> None:
        """Tell the backend of a process that was seen to end: a lost one may still write."""
        if ended is not None and ended.code is not None:
            self.backend.ended(job.run_id)

    def _start_some(self) -> None:
        with suppress(OSError):  # missing or out of reach: the start of a training will show it
            self.full = shutil.disk_usage(self.store.path).free < self.low_bytes
        written = [job for job in self.jobs if job.state in ("running", "elsewhere")]
        busy = sum(not self._away(job) for job in written)
        slots = self.engine.slots
        now = time.monotonic()
        due = [s for s in self._order if s.state == "waiting" and now >= s.not_before]
        for job in due:
            if busy >= slots or self.full or not self._reached(self._start, job):
                return
            busy += job.state != "finished" and not self._away(job)

    def _away(self, job: Job) -> bool:
        """Whether another machine trains it, with a core of its own."""
        return job.state == "elsewhere" and not self.backend.written_here(self._reader(job))

    def _start(self, job: Job) -> None:
        self.backend.look(job.run_id, now=True)
        run = self._reader(job)
        if is_done(job.trial, run):
            job.state, job.note = "finished", "by another process"
            return
        if self.backend.written(run):
            job.state, job.note = "elsewhere", ELSEWHERE
            return
        at = checkpoint.newest(run.path / checkpoint.FOLDER)
        if at is None and job.run_id != job.trial.run_id:
            job.run_id = job.trial.run_id  # it cannot go on; what has the own name perhaps can
            self._start(job)
            return
        self._forgive(job)
        job.attempts += 1
        job.step = -1 if at is None else at
        try:
            words = self._words(job, at)
            job.process = self._spawn(self.backend.words(job.run_id, words), job.log)
            job.state = "running"
        except BusyError as error:
            self._leave(job, str(error))
        except (UserError, OSError) as error:
            self._judge(job, str(error), hopeless=isinstance(error, UserError))

    def _words(self, job: Job, at: int | None) -> list[str]:
        """The arguments of `tom train` that resume a training, or start it."""
        named = [f"{plugins.OPTION}={word}" for word in plugins.wanted_here()]
        if at is not None and not job.anew:
            run, steps = self._reader(job), job.trial.config.steps
            rest = [f"--steps={steps}"] if given_fewer(job.trial, run) else []
            return [f"--resume={job.run_id}", *rest, *job.trial.code(), *named, *self._accepted]
        job.run_id, job.anew = job.trial.run_id, False
        path = self.store.path / job.run_id
        if at is None and (closed := checkpoint.look_for(path / checkpoint.FOLDER)[1]):
            raise UserError(f"{closed}: make it readable")
        if path.is_dir():  # it has no checkpoint to resume from
            where = self.backend.begin_anew(job.run_id)
            job.note = f"began anew; what was there is in {where}"
        return [*job.trial.options(), f"--run-id={job.run_id}", *named, *self._accepted]

    def _spawn(self, words: Sequence[str], log: Path) -> Process:
        log.parent.mkdir(parents=True, exist_ok=True)
        with log.open("a", errors="backslashreplace") as out:  # a path may be no text
            out.write(f"$ {' '.join(words)}\n")
        return self.engine.start(words, log)

    def _ended(self, job: Job, ended: Exit) -> None:
        run, said = self._reader(job), _tail(job.log)
        why = f"{ended.why or run.status.reason or f'exit code {ended.code}'}\n{said}"
        if is_done(job.trial, run):  # even if nobody saw its process end
            job.state, job.note = "finished", ""
        elif self.backend.written(run):
            job.state, job.note = "elsewhere", ELSEWHERE
            # Or it is its own last heartbeat, on another machine. A refusal was for the other.
            job.ended = why if ended.code != 2 else ""
        elif ended.code == 2 and lock.WRITTEN in said:
            self._leave(job, why)
        else:
            # Hours of training may be in it: only if it can never go on does it begin anew.
            never = START_AGAIN in said and ACCEPT not in said
            job.anew = ended.code == 2 and job.step >= 0 and never
            gone = job.step >= 0 and not run.path.is_dir()  # in the trash, by another sweep
            later = gone or job.anew or NOT_NOW in said or TAKEN in said
            self._judge(job, why, hopeless=ended.code == 2 and not later)

    def _leave(self, job: Job, why: str) -> None:
        """Another process had the run for that moment: no attempt has failed. Look again later."""
        job.attempts = max(job.attempts - 1, 0)
        self._judge(job, why, hopeless=False)

    def _judge(self, job: Job, why: str, hopeless: bool) -> None:
        """Decide about a training that ended early: try again later, or give it up."""
        job.note, job.ended = why.strip(), ""
        self._forgive(job)
        full = shutil.disk_usage(self.store.path).free < self.low_bytes
        if full:
            # Not its own fault, even if it was refused: it waits for disk space.
            job.attempts = max(job.attempts - 1, 0)
        given_up = not full and (hopeless or job.attempts >= ATTEMPTS)
        job.state = "failed" if given_up else "waiting"
        job.not_before = time.monotonic() + self.back_off_s * 2 ** max(job.attempts - 1, 0)

    def _watch(self, job: Job) -> None:
        run = self._reader(job)
        if is_done(job.trial, run):
            job.state, job.note = "finished", "by another process"
        elif not self.backend.written(run):
            if job.ended:
                self._judge(job, job.ended, hopeless=False)
            else:
                job.state, job.note = "waiting", ""

    def _forgive(self, job: Job) -> None:
        """Forget the attempts of a training that has got further: its failures are not the same."""
        at = checkpoint.newest(self.store.path / job.run_id / checkpoint.FOLDER)
        if at is not None and at > job.step:
            job.attempts = 0

    def _reader(self, job: Job) -> RunReader:
        return RunReader(self.store.path / job.run_id)


def _tail(log: Path) -> str:
    """The last lines that the last command wrote."""
    try:
        lines = log.read_text(errors="replace").splitlines()
    except OSError:
        return ""
    begun = max((i for i, line in enumerate(lines) if line.startswith("$ ")), default=-1)
    return "\n".join(lines[begun + 1 :][-TAIL_LINES:])
