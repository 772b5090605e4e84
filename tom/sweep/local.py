"""Runs a sweep on this machine: one single-threaded process a core.

The run folders are the only memory: a driver that is killed and started again finds what is done,
what can go on, and what another process is writing. Ctrl-C asks the trainings to stop; the kernel
does the same when the driver itself is killed.
"""

import ctypes
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from tom.errors import UserError
from tom.record import RunReader, Store, checkpoint, lock, manage
from tom.sweep.plan import Trial, same_run

State = Literal["waiting", "running", "elsewhere", "finished", "failed", "stopped"]

LOGS = ".sweep"
ATTEMPTS = 3
"""A training that ends so often without getting further is given up."""

BACK_OFF_S = 5.0  # before the second attempt; doubled for each more
LOW_BYTES = 200e6  # with less room on the disk nothing is started, and no failure is counted
KILL_AFTER_S = 300.0  # a training writes its checkpoint within this once it is asked to stop
TAIL_LINES = 5
_PR_SET_PDEATHSIG = 1


@dataclass
class Seat:
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
    process: subprocess.Popen[bytes] | None = field(default=None, repr=False)


class Driver:
    """Runs `trials` in `store`, `workers` at a time. Call `poll` until it says that all is done."""

    def __init__(
        self,
        store: Store,
        trials: Sequence[Trial],
        workers: int,
        low_bytes: float = LOW_BYTES,
        back_off_s: float = BACK_OFF_S,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.store = store
        self.workers = workers
        self.low_bytes = low_bytes
        self.back_off_s = back_off_s
        self._clock = clock
        runs = store.runs()
        logs = store.path / LOGS
        self.seats: list[Seat] = []
        for trial in trials:
            run = same_run(trial, runs)
            run_id = run.run_id if run else trial.run_id
            seat = Seat(trial, logs / f"{run_id}.log", run_id)
            if run and run.status.state == "finished":
                seat.state, seat.note = "finished", "was there already"
            self.seats.append(seat)
        self.full = False

    def poll(self) -> bool:
        """Look after every training once; True when there is nothing left to do."""
        for seat in self.seats:
            if seat.process and (code := seat.process.poll()) is not None:
                seat.process = None
                self._ended(seat, code)
            elif seat.state == "elsewhere":
                self._watch(seat)
        self._start_some()
        return all(seat.state in ("finished", "failed", "stopped") for seat in self.seats)

    def stop(self, wait_s: float = KILL_AFTER_S) -> None:
        """Ask every training to stop and wait for them; those that do not are killed.

        KeyboardInterrupt while it waits kills them at once.
        """
        running = [seat for seat in self.seats if seat.process]
        for seat in running:
            _signal(seat, signal.SIGTERM)
        until = self._clock() + wait_s
        with suppress(KeyboardInterrupt):  # asked twice: the checkpoints they have must do
            while self._clock() < until and any(_lives(seat) for seat in running):
                time.sleep(0.1)
        for seat in running:
            if _lives(seat):
                _signal(seat, signal.SIGKILL)
            if seat.process:
                seat.process.wait()
            seat.process = None
            finished = self._reader(seat).status.state == "finished"
            seat.state = "finished" if finished else "stopped"

    def _start_some(self) -> None:
        free = shutil.disk_usage(self.store.path).free if self.store.path.is_dir() else None
        self.full = free is not None and free < self.low_bytes
        busy = sum(seat.state in ("running", "elsewhere") for seat in self.seats)
        for seat in self.seats:
            if busy >= self.workers or self.full:
                return
            if seat.state == "waiting" and self._clock() >= seat.not_before:
                self._start(seat)
                busy += 1

    def _start(self, seat: Seat) -> None:
        path = self.store.path / seat.run_id
        if path.is_dir() and lock.held(path):
            seat.state, seat.note = "elsewhere", "another process is writing it"
            return
        at = checkpoint.newest(path / checkpoint.FOLDER)
        if seat.attempts and at is not None and at > seat.step:
            seat.attempts = 0  # it got further: this is not what always fails
        seat.attempts += 1
        seat.step = -1 if at is None else at
        try:
            seat.process = _spawn(self._words(seat, at), seat.log)
            seat.state = "running"
        except (UserError, OSError) as error:
            self._judge(seat, str(error), hopeless=isinstance(error, UserError))

    def _words(self, seat: Seat, at: int | None) -> list[str]:
        """The words of `tom train` that take a training up, or begin it."""
        shared = [f"--store={self.store.path}", "--no-rerun"]
        if at is not None and not seat.anew:
            return [f"--resume={seat.run_id}", *shared]
        seat.run_id, seat.anew = seat.trial.run_id, False
        if (self.store.path / seat.run_id).is_dir():  # nothing in it to go on from
            seat.note = f"began anew; what was there is in {manage.trash(self.store, seat.run_id)}"
        return [*seat.trial.options(), f"--run-id={seat.run_id}", *shared]

    def _ended(self, seat: Seat, code: int) -> None:
        run = self._reader(seat)
        if code == 0 and run.status.state == "finished":
            seat.state, seat.note = "finished", ""
        elif run.path.is_dir() and lock.held(run.path):
            seat.state, seat.note = "elsewhere", "another process is writing it"
        else:
            why = f"killed by signal {-code}" if code < 0 else run.status.reason
            seat.anew = code == 2 and seat.step >= 0
            refused = code == 2 and not seat.anew
            self._judge(seat, f"{why or f'exit code {code}'}\n{_tail(seat.log)}", refused)

    def _judge(self, seat: Seat, why: str, hopeless: bool) -> None:
        """It ended before its time: once more, later, or never again."""
        seat.note = why.strip()
        full = shutil.disk_usage(self.store.path).free < self.low_bytes
        if full:
            seat.attempts -= 1  # no fault of its own, also where it was refused: it waits for room
        given_up = not full and (hopeless or seat.attempts >= ATTEMPTS)
        seat.state = "failed" if given_up else "waiting"
        seat.not_before = self._clock() + self.back_off_s * 2 ** max(seat.attempts - 1, 0)

    def _watch(self, seat: Seat) -> None:
        run = self._reader(seat)
        if run.status.state == "finished":
            seat.state, seat.note = "finished", "by another process"
        elif not lock.held(run.path) and not run.status.alive:
            seat.state, seat.note = "waiting", ""

    def _reader(self, seat: Seat) -> RunReader:
        return RunReader(self.store.path / seat.run_id)


def _spawn(words: Sequence[str], log: Path) -> subprocess.Popen[bytes]:
    log.parent.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, "-m", "tom", "train", *words]
    with log.open("ab") as out:
        out.write(f"$ tom train {' '.join(words)}\n".encode())
        out.flush()
        return subprocess.Popen(
            command,
            env={**os.environ, "OMP_NUM_THREADS": "1"},
            stdin=subprocess.DEVNULL,
            stdout=out,
            stderr=out,
            start_new_session=True,  # Ctrl-C is the driver's to pass on
            preexec_fn=_end_with_parent,
        )


def _end_with_parent() -> None:
    """Let the kernel send SIGTERM when the driver dies, of kill -9 too: trainings stop cleanly."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)


def _signal(seat: Seat, number: signal.Signals) -> None:
    if seat.process and seat.process.poll() is None:
        seat.process.send_signal(number)


def _lives(seat: Seat) -> bool:
    return seat.process is not None and seat.process.poll() is None


def _tail(log: Path) -> str:
    try:
        lines = log.read_text(errors="replace").splitlines()
    except OSError:
        return ""
    return "\n".join(line for line in lines[-TAIL_LINES:] if not line.startswith("$ "))
