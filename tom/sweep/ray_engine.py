"""Trainings on the machines of a Ray cluster, one core each.

Ray only chooses a machine with a free core, starts the process there, and says when a machine died.
"""

import logging
import os
import shutil
import socket
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from signal import SIGKILL
from typing import Any

import ray
from ray.exceptions import RayError

from tom.errors import GoneError, UserError, reason
from tom.machine import processes

CONNECT_S, GONE_S = 2.0, 20.0  # Ray takes 60 s, and then ends the process with a message of its own
OBJECT_STORE_BYTES = 80_000_000  # the minimum that Ray accepts: it only carries log lines


class Training:
    """A process on some machine of the cluster.

    It is an actor: of a task Ray does not report that its machine is silent.
    """

    def __init__(self, arguments: Sequence[str], folder: str) -> None:
        """It starts in `folder` if this machine has it, because the user's modules may be there."""
        if Path(folder).is_dir():
            os.chdir(folder)
        self._out = tempfile.TemporaryFile()  # noqa: SIM115 - open as long as this object exists
        self._process = processes.start_module(arguments, self._out)

    def wait(self) -> tuple[int, bytes]:
        """The exit code and the output."""
        code = self._process.wait()
        self._out.seek(0)
        return code, self._out.read()

    def terminate(self) -> None:
        self._process.terminate()


# Two calls at a time: it is asked to stop while `wait` waits. The driver knows about restarts.
_Training = ray.remote(Training).options(num_cpus=1, max_restarts=0, max_concurrency=2)


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
                ray.init(
                    "local",
                    num_cpus=jobs,
                    include_dashboard=False,
                    object_store_memory=OBJECT_STORE_BYTES,
                    log_to_driver=False,
                    logging_level=logging.ERROR,
                    _temp_dir=str(self._folder),
                )
            host, _, port = ray.get_runtime_context().gcs_address.rpartition(":")
            self._head = (host.strip("[]"), int(port))
            self._node = ray.get_runtime_context().get_node_id()
        except (RayError, OSError, RuntimeError, ValueError, AssertionError) as error:
            self.__exit__()
            hint = "`ray start --head` may say more"
            if address:
                hint = "is its token RAY_AUTH_TOKEN, and is this machine one of its nodes?"
            where = f"join the Ray cluster at {address}" if address else "start Ray"
            raise UserError(f"cannot {where} ({reason(error)}): {hint}") from error
        self._answered = time.monotonic()

    @property
    def slots(self) -> int:
        """The number of cores; 0 while the head or this machine's node is silent.

        Raises GoneError after GONE_S of silence.
        """
        try:  # without either of these Ray waits for ever
            socket.create_connection(self._head, CONNECT_S).close()
            alive = {node["NodeID"] for node in ray.nodes() if node["Alive"]}
            silent = "" if self._node in alive else "the Ray node of this machine"
        except OSError:
            silent = "the head of the Ray cluster"
        if silent and time.monotonic() - self._answered < GONE_S:
            return 0
        if silent:
            raise GoneError(
                f"{silent} has not answered for {GONE_S:.0f} s: trainings stop with a checkpoint "
                "once they notice"
            )
        self._answered = time.monotonic()
        cores = int(ray.cluster_resources().get("CPU", 0))
        return cores if self._jobs is None else min(cores, self._jobs)

    def start(self, arguments: Sequence[str], log: Path) -> "RayProcess":
        return RayProcess(_Training.remote(list(arguments), str(Path.cwd())), log)

    def __exit__(self, *_: object) -> None:
        ray.shutdown()
        if self._folder:
            shutil.rmtree(self._folder, ignore_errors=True)


class RayProcess:
    """A process on the cluster, whose output comes with its end."""

    def __init__(self, actor: Any, log: Path) -> None:
        """`actor` is the handle of a `Training`, whose methods Ray's types do not include."""
        self._actor = actor
        self._log = log
        self._begun = actor.__ray_ready__.remote()
        self._end = actor.wait.remote()
        self._code: int | None = None

    def poll(self) -> int | None:
        if self._code is None and ray.wait([self._end], timeout=0)[0]:
            try:
                self._code, output = ray.get(self._end)
            except RayError as error:
                self._code, output = -SIGKILL, f"no answer: {reason(error)}\n".encode()
            with self._log.open("ab") as log:
                log.write(output)
            ray.kill(self._actor)
        return self._code

    def terminate(self) -> None:
        if ray.wait([self._begun], timeout=0)[0]:
            self._actor.terminate.remote()
        else:  # it waits for a free core
            self.kill()

    def kill(self) -> None:
        ray.kill(self._actor)


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
