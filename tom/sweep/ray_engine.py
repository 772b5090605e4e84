"""Trainings as processes on the machines of a Ray cluster, one core each.

Ray only chooses a machine with a free core and transmits signals and output. The run folder says
how a training ended.
"""

import logging
import os
import shutil
import signal
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

import ray
from ray.exceptions import ActorUnavailableError, RayError

from tom.errors import UserError
from tom.sweep.engine import KILL_S, Exit, LocalProcess, lives, spawn
from tom.sweep.ray_head import Head
from tom.sweep.watchdog import Watchdog

_JOIN = (
    "cannot join the Ray cluster at {address} ({reason}): has it another token (RAY_AUTH_TOKEN or "
    "~/.ray/auth_token), and is this machine one of its nodes?"
)
_BEGIN = "cannot start Ray ({reason}): `ray start --head` may say more"
OBJECT_STORE_BYTES = 80_000_000  # the minimum that Ray accepts: it only carries log lines


class Remote:
    """A process on some machine of the cluster, and its output."""

    def __init__(self, words: Sequence[str], folder: str) -> None:
        """It starts in `folder` if this machine has it, because the user's modules may be there."""
        if Path(folder).is_dir():
            os.chdir(folder)
        self._out = tempfile.TemporaryFile()  # noqa: SIM115 - open as long as this object exists
        self._process = LocalProcess(spawn(words, self._out))
        self._read = 0

    def look(self) -> tuple[Exit | None, bytes]:
        """How it ended (None while it runs), and its output since the last call."""
        ended = self._process.poll()  # before the output is read, which is complete after the end
        file = self._out.fileno()  # the process writes at the file's offset, which must not move
        output = os.pread(file, os.fstat(file).st_size - self._read, self._read)
        self._read += len(output)
        return ended, output

    def signal(self, number: int) -> None:
        self._process.signal(signal.Signals(number))


_Remote = ray.remote(num_cpus=1, max_restarts=0)(Remote)


class RayEngine(AbstractContextManager["RayEngine", None]):
    """Starts processes on a cluster, never more than it has cores."""

    def __init__(self, address: str | None, jobs: int | None) -> None:
        """Join the cluster at `address`, or start one. Raises UserError if that fails."""
        self._jobs = jobs
        self._folder = None if address else Path(tempfile.mkdtemp(prefix="tom-ray-"))
        try:
            if address:
                with _without_stderr():
                    ray.init(address, log_to_driver=False, logging_level=logging.ERROR)
            else:
                self._begin()
            self._head = Head(ray.get_runtime_context().gcs_address)
        except (RayError, OSError, RuntimeError, ValueError, AssertionError) as error:
            self.__exit__()
            what = _JOIN if address else _BEGIN
            raise UserError(what.format(address=address, reason=_one_line(error))) from error

    def _begin(self) -> None:
        ray.init(
            "local",
            num_cpus=self._jobs,
            include_dashboard=False,
            object_store_memory=OBJECT_STORE_BYTES,
            log_to_driver=False,
            logging_level=logging.ERROR,
            _temp_dir=str(self._folder),
        )

    @property
    def slots(self) -> int:
        """The number of cores; 0 while the head is silent, as Ray would wait. Raises GoneError."""
        if not self._head.answers():
            return 0
        cores = int(ray.cluster_resources().get("CPU", 0))
        return cores if self._jobs is None else min(cores, self._jobs)

    def start(self, words: Sequence[str], log: Path) -> "RayProcess":
        return RayProcess(_Remote.remote(list(words), str(Path.cwd())), log)

    def __exit__(self, *_: object) -> None:
        ray.shutdown()
        if self._folder:
            shutil.rmtree(self._folder, ignore_errors=True)


class RayProcess:
    """A process on the cluster. Requests for its state are answered when it can."""

    def __init__(self, actor: Any, log: Path) -> None:
        """`actor` is the handle of a `Remote`, whose methods Ray's types do not include."""
        self._actor = actor
        self._log = log
        self._watchdog = Watchdog()
        self._ended: Exit | None = None
        self._asked = actor.look.remote()

    def poll(self) -> Exit | None:
        if self._ended is None and ray.wait([self._asked], timeout=0)[0]:
            self._hear()
        return self._ended

    def signal(self, number: signal.Signals) -> None:
        if self.poll() is None and not self._watchdog.started:
            ray.kill(self._actor)
            self._ended = Exit(None, "had not begun")
        elif self._ended is None:
            self._actor.signal.remote(int(number))

    def silent_s(self) -> float:
        return self._watchdog.silent_s

    def end(self) -> None:
        self.signal(signal.SIGKILL)
        lives(self, KILL_S)
        ray.kill(self._actor)

    def _hear(self) -> None:
        """Receive the answer and send the next request."""
        try:
            ended, output = ray.get(self._asked)
            with self._log.open("ab") as log:
                log.write(output)
            self._watchdog.reset()
            self._ended = ended
        except RayError as error:
            self._ended = ended_by(error)
        if self._ended is None:
            self._asked = self._actor.look.remote()


@contextmanager
def _without_stderr() -> Iterator[None]:
    """Hide the errors of Ray's core while it joins: it repeats them every second; we report one."""
    sys.stderr.flush()
    kept = os.dup(2)
    try:
        with Path(os.devnull).open("wb") as nowhere:
            os.dup2(nowhere.fileno(), 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)


def ended_by(error: RayError) -> Exit | None:
    """How a process ended whose machine gave no answer; None if Ray still expects one."""
    if isinstance(error, ActorUnavailableError):
        return None  # the watchdog measures the silence, because Ray may wait forever
    return Exit(None, f"its machine or Ray's process there died: {_one_line(error)}")


def _one_line(error: BaseException) -> str:
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return " ".join(lines[:1] + lines[1:][-1:])[:400] or type(error).__name__
