"""Runs a sweep: starts trainings, judges them by their run folders, and starts them again.

The run folders are the only memory: a driver that is killed and started again finds what is done,
what can go on, and what another process is writing. Ctrl-C asks the trainings to stop; the kernel
does the same when the driver itself is killed. Where the trainings run is the engine's business,
where the runs lie the home's.
"""

import shutil
import signal
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from tom.errors import UserError
from tom.record import RunReader, checkpoint
from tom.sweep.engine import Engine, Exit, Process, lives
from tom.sweep.home import LOGS, Home
from tom.sweep.silence import lost
from tom.training.plan import Trial, same_run

State = Literal["waiting", "running", "elsewhere", "finished", "failed", "stopped"]

ATTEMPTS = 3
"""A training that ends so often without getting further is given up."""

BACK_OFF_S = 5.0  # before the second attempt; doubled for each more
LOW_BYTES = 200e6  # with less room on the disk nothing is started, and no failure is counted
KILL_AFTER_S = 300.0  # a training writes its checkpoint within this once it is asked to stop
TAIL_LINES = 5


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
    process: Process | None = field(default=None, repr=False)


class Driver:
    """Runs `trials` whose runs lie in `home`. Call `poll` until it says that all is done."""

    def __init__(
        self,
        home: Home,
        trials: Sequence[Trial],
        engine: Engine,
        low_bytes: float = LOW_BYTES,
        back_off_s: float = BACK_OFF_S,
    ) -> None:
        self.home = home
        self.store = home.store
        self.engine = engine
        self.low_bytes = low_bytes
        self.back_off_s = back_off_s
        runs = self.store.runs()
        logs = self.store.path / LOGS
        self.seats: list[Seat] = []
        for trial in trials:
            run = same_run(trial, runs)
            run_id = run.run_id if run else trial.run_id
            seat = Seat(trial, logs / f"{run_id}.log", run_id)
            if run and run.status.state == "finished":
                copy = "a small copy, " if run.small_copy else ""
                seat.state, seat.note = "finished", f"{copy}was there already"
            self.seats.append(seat)
        self._order = list(self.seats)
        """in which they are looked after"""
        self.full = False
        self.trouble = ""
        """why the runs cannot be reached at present"""

    def poll(self) -> bool:
        """Look after every training once; True when there is nothing left to do.

        One that cannot be reached is not judged, and ends the round: its home may be away, and then
        every question takes its time. The others come before it in the next poll.
        """
        self.trouble = ""
        for seat in tuple(self._order):
            if not self._reached(self._attend, seat):
                break
        self._start_some()
        return all(seat.state in ("finished", "failed", "stopped") for seat in self.seats)

    def stop(self, wait_s: float = KILL_AFTER_S) -> None:
        """Ask every training to stop and wait for them; those that do not are killed.

        KeyboardInterrupt while it waits kills them at once.
        """
        running = [(seat, seat.process) for seat in self.seats if seat.process]
        for _, process in running:
            process.signal(signal.SIGTERM)
        until = time.monotonic() + wait_s
        with suppress(KeyboardInterrupt):  # asked twice: the checkpoints they have must do
            while time.monotonic() < until and any(lives(process) for _, process in running):
                time.sleep(0.1)
        for seat, process in running:
            process.end()
            seat.process = None
            with suppress(OSError):  # out of reach: what was last seen of it must do
                self.home.look(seat.run_id, now=True)
            finished = self._reader(seat).status.state == "finished"
            seat.state = "finished" if finished else "stopped"

    def _reached(self, look: Callable[[Seat], None], seat: Seat) -> bool:
        """Do `look`; False where the training cannot be reached: it is the last one from now on."""
        try:
            look(seat)
        except OSError as error:
            self.trouble = str(error)
            self._order.remove(seat)
            self._order.append(seat)
            return False
        return True

    def _attend(self, seat: Seat) -> None:
        """Look after one training."""
        if seat.state not in ("running", "elsewhere"):
            return
        self.home.look(seat.run_id)
        if seat.process is None:
            self._watch(seat)
            return
        ended = seat.process.poll() or lost(seat.process.silent_s(), self._reader(seat).status)
        if ended is not None:
            self.home.look(seat.run_id, now=True)
            seat.process.end()
            seat.process = None
            self._ended(seat, ended)

    def _start_some(self) -> None:
        with suppress(OSError):  # not there yet, or out of reach: a start will find out
            self.full = shutil.disk_usage(self.store.path).free < self.low_bytes
        busy = sum(seat.state in ("running", "elsewhere") for seat in self.seats)
        slots = self.engine.slots
        now = time.monotonic()
        due = [s for s in self._order if s.state == "waiting" and now >= s.not_before]
        for seat in due:
            if busy >= slots or self.full or not self._reached(self._start, seat):
                return
            busy += 1

    def _start(self, seat: Seat) -> None:
        self.home.look(seat.run_id, now=True)
        run = self._reader(seat)
        if run.status.state == "finished":
            seat.state, seat.note = "finished", "by another process"
            return
        if self.home.written(run):
            seat.state, seat.note = "elsewhere", "another process is writing it"
            return
        at = checkpoint.newest(run.path / checkpoint.FOLDER)
        if seat.attempts and at is not None and at > seat.step:
            seat.attempts = 0  # it got further: this is not what always fails
        seat.attempts += 1
        seat.step = -1 if at is None else at
        try:
            words = self.home.words(seat.run_id, self._words(seat, at))
            seat.process = self._spawn(words, seat.log)
            seat.state = "running"
        except (UserError, OSError) as error:
            self._judge(seat, str(error), hopeless=isinstance(error, UserError))

    def _words(self, seat: Seat, at: int | None) -> list[str]:
        """The words of `tom train` that take a training up, or begin it."""
        if at is not None and not seat.anew:
            return [f"--resume={seat.run_id}"]
        seat.run_id, seat.anew = seat.trial.run_id, False
        if (self.store.path / seat.run_id).is_dir():  # nothing in it to go on from
            where = self.home.begin_anew(seat.run_id)
            seat.note = f"began anew; what was there is in {where}"
        return [*seat.trial.options(), f"--run-id={seat.run_id}"]

    def _spawn(self, words: Sequence[str], log: Path) -> Process:
        log.parent.mkdir(parents=True, exist_ok=True)
        with log.open("a") as out:
            out.write(f"$ {' '.join(words)}\n")
        return self.engine.start(words, log)

    def _ended(self, seat: Seat, ended: Exit) -> None:
        run = self._reader(seat)
        if run.status.state == "finished":  # also where nobody saw its process end
            seat.state, seat.note = "finished", ""
        elif self.home.written(run):
            seat.state, seat.note = "elsewhere", "another process is writing it"
        else:
            why = ended.why or run.status.reason or f"exit code {ended.code}"
            seat.anew = ended.code == 2 and seat.step >= 0
            refused = ended.code == 2 and not seat.anew
            self._judge(seat, f"{why}\n{_tail(seat.log)}", refused)

    def _judge(self, seat: Seat, why: str, hopeless: bool) -> None:
        """It ended before its time: once more, later, or never again."""
        seat.note = why.strip()
        full = shutil.disk_usage(self.store.path).free < self.low_bytes
        if full:
            seat.attempts -= 1  # no fault of its own, also where it was refused: it waits for room
        given_up = not full and (hopeless or seat.attempts >= ATTEMPTS)
        seat.state = "failed" if given_up else "waiting"
        seat.not_before = time.monotonic() + self.back_off_s * 2 ** max(seat.attempts - 1, 0)

    def _watch(self, seat: Seat) -> None:
        run = self._reader(seat)
        if run.status.state == "finished":
            seat.state, seat.note = "finished", "by another process"
        elif not self.home.written(run) and not run.status.alive:
            seat.state, seat.note = "waiting", ""

    def _reader(self, seat: Seat) -> RunReader:
        return RunReader(self.store.path / seat.run_id)


def _tail(log: Path) -> str:
    try:
        lines = log.read_text(errors="replace").splitlines()
    except OSError:
        return ""
    return "\n".join(line for line in lines[-TAIL_LINES:] if not line.startswith("$ "))
