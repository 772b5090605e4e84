"""Servers as child processes: free ports, health checks, and an end without orphans."""

import errno
import http.client
import os
import signal
import socket
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from tom.harmless import terminal
from tom.machine import address, processes

STOP_GRACE_S = 3.0
LOG_TAIL = 12
HEALTH_BYTES = 65536


@dataclass
class Server:
    """One server: its command, its address and its log."""

    name: str
    command: Sequence[str]
    environment: Mapping[str, str]
    host: str
    port: int
    health: str
    """path that returns 200 once the server is ready"""
    log: Path
    mark: str = ""
    """text of the answer that proves the server to be this one, not another on its port"""
    process: processes.Process | None = field(default=None, init=False)
    started: float = field(default=0.0, init=False)
    """on the monotonic clock"""

    def start(self) -> None:
        """Start it in a new process group, which ends with this process."""
        self.started = time.monotonic()
        with self.log.open("ab") as log:
            self.process = processes.start(self.command, log, {**os.environ, **self.environment})

    @property
    def running(self) -> bool:
        return self.process is not None and self.process.poll() is None

    @property
    def port_was_taken(self) -> bool:
        """Whether it has ended and another program has its port."""
        return not self.running and not is_free(self.host, self.port)

    def healthy(self) -> bool:
        """Whether it answers, and with its mark."""
        connection = http.client.HTTPConnection(self.host, self.port, timeout=2)
        try:
            connection.request("GET", self.health)
            answer = connection.getresponse()
            return answer.status == 200 and self.mark.encode() in answer.read(HEALTH_BYTES)
        except (OSError, http.client.HTTPException):
            return False
        finally:
            connection.close()

    def wait_until_healthy(self, deadline: float, stopped: Callable[[], bool]) -> bool:
        """Wait until it answers; False if it ended, on a timeout, or if the studio stops."""
        while self.running and time.monotonic() < deadline and not stopped():
            if self.healthy():
                return True
            time.sleep(0.05)
        return False

    def tail(self) -> str:
        """The last lines of its output."""
        lines = self.log.read_text(errors="replace").splitlines() if self.log.exists() else []
        return "\n".join(map(terminal, lines[-LOG_TAIL:]))


def stop(servers: Sequence[Server]) -> None:
    """End every server with its children: SIGTERM, and after a grace period SIGKILL."""
    started = [server.process for server in servers if server.process is not None]
    deadline = time.monotonic() + STOP_GRACE_S
    for number in (signal.SIGTERM, signal.SIGKILL):
        for process in started:
            with suppress(ProcessLookupError):  # the whole group has ended
                os.killpg(process.pid, number)
        for process in started:
            with suppress(subprocess.TimeoutExpired):
                process.wait(max(deadline - time.monotonic(), 0.0))
    for process in started:
        process.wait()


def free_port(host: str, preferred: int = 0) -> int:
    """`preferred` if it is free on `host`, else any free port."""
    return preferred if preferred and is_free(host, preferred) else address.free_port(host)


def is_free(host: str, port: int) -> bool:
    """Whether `port` of `host` is free. Raises OSError for a host that is not this machine."""
    with socket.socket(address.family(host), socket.SOCK_STREAM) as probe:
        # Like the servers: a port in TIME_WAIT counts as free.
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except OSError as error:
            if error.errno in (errno.EADDRINUSE, errno.EACCES):  # a privileged port
                return False
            raise
        return True
