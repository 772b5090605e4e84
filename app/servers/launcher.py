"""Start the page server with its links, and end it with all that it has started."""

import errno
import http.client
import os
import secrets
import signal
import socket
import subprocess
import sys
import tempfile
import time
import webbrowser
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from threading import Event

from app.links import Links
from tom.errors import UserError
from tom.harmless import terminal
from tom.machine import address, processes

DEFAULT_PORT = 8600
START_TIMEOUT_S = 60.0
ATTEMPTS = 3
"""launches, each on a newly found port, before the studio gives up"""
SETTINGS = {
    "OMP_NUM_THREADS": "1",
    "MALLOC_ARENA_MAX": "2",
    "MALLOC_MMAP_THRESHOLD_": "262144",
    "MALLOC_TRIM_THRESHOLD_": "262144",
    "ARROW_DEFAULT_MEMORY_POOL": "system",
}
"""settings under which a server's threads share the cores, and return what they have freed"""
OPEN = (
    "tom studio: reachable from other machines without a password; everybody who reaches this host "
    "can read the runs"
)
STOP_GRACE_S = 3.0
LOG_TAIL = 12
HEALTH, HEALTH_BYTES = "/api/health", 65536


class Server:
    """The page server, which starts the others when they are needed, as a process.

    Its process group ends with this process.
    """

    def __init__(self, links: Links) -> None:
        self.links, self.log = links, links.file("log")
        command = [sys.executable, "-m", "app.servers.pages"]
        environment = {**os.environ, **links.environment(), **SETTINGS}
        with self.log.open("wb") as log:
            self.process = processes.start(command, log, environment)

    @property
    def running(self) -> bool:
        return self.process.poll() is None

    @property
    def port_was_taken(self) -> bool:
        """Whether it has ended and another program has its port."""
        return not self.running and not is_free(self.links.host, self.links.port)

    def healthy(self) -> bool:
        """Whether it answers, and no other program on its port."""
        host = address.local_host(self.links.host)
        connection = http.client.HTTPConnection(host, self.links.port, timeout=2)
        try:
            connection.request("GET", HEALTH)
            return self.links.launch.encode() in connection.getresponse().read(HEALTH_BYTES)
        except (OSError, http.client.HTTPException):
            return False
        finally:
            connection.close()

    def wait_until_healthy(self, timeout_s: float, stopped: Callable[[], bool]) -> bool:
        """Wait until it answers; False if it ended, on a timeout, or if the studio stops."""
        deadline = time.monotonic() + timeout_s
        while self.running and time.monotonic() < deadline and not stopped():
            if self.healthy():
                return True
            time.sleep(0.05)
        return False

    def tail(self) -> str:
        """The last lines of its output."""
        lines = self.log.read_text(errors="replace").splitlines()
        return "\n".join(map(terminal, lines[-LOG_TAIL:]))

    def stop(self) -> None:
        """End it with all its children: SIGTERM, and after a grace period SIGKILL."""
        for number in (signal.SIGTERM, signal.SIGKILL):
            with suppress(ProcessLookupError):  # the whole group has ended
                os.killpg(self.process.pid, number)
            with suppress(subprocess.TimeoutExpired):
                self.process.wait(STOP_GRACE_S)
        self.process.wait()


def run(requested: Links, *, browser: bool) -> int:
    """Serve until SIGINT or SIGTERM (returns 0), or until the page server fails (returns 1)."""
    stopping = Event()
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, lambda *_: stopping.set())
    with serving(requested, stopping) as (links, server):
        if stopping.is_set():
            return 0
        if server is None:
            return 1
        missing = "" if Path(links.store).exists() else ", which is not there yet"
        store = f"store {links.store}{missing}"
        print(f"tom studio: {links.user_address()}  ({store}; Ctrl-C stops it)", flush=True)
        if links.base:
            print(f"            behind a proxy: its address in place of {links.root}", flush=True)
        elif links.local_only:
            tunnel = f"-L {links.port}:{links.root.removeprefix('http://')}"
            print(f"            over SSH: ssh {tunnel} THIS-MACHINE", flush=True)
        display = sys.platform != "linux" or {"DISPLAY", "WAYLAND_DISPLAY"} & {*os.environ}
        if browser and display:
            # A file that redirects to it, because all users can see a browser's arguments.
            page = links.file("studio.html")
            page.write_text(
                f'<!doctype html><script>location.replace("{links.user_address()}")</script>'
            )
            webbrowser.open(page.as_uri())
        while not stopping.wait(0.5):
            if not server.running:
                print(f"tom studio: the page server ended:\n{server.tail()}", file=sys.stderr)
                return 1
        return 0


@contextmanager
def serving(requested: Links, stopping: Event) -> Iterator[tuple[Links, Server | None]]:
    """The links and the healthy page server of a studio as `requested`; None if it did not start.

    Raises UserError if it cannot listen where it should.
    """
    with tempfile.TemporaryDirectory(prefix="tom-studio-") as folder, ExitStack() as started:
        links, attempts = with_port_and_key(requested, folder), 0
        if not links.local_only:
            print(OPEN, file=sys.stderr)
        while True:
            server = Server(links)
            started.callback(server.stop)
            up = server.wait_until_healthy(START_TIMEOUT_S, stopping.is_set)
            attempts += 1
            if up or stopping.is_set() or not server.port_was_taken or attempts == ATTEMPTS:
                break
            # Another program took it, if only for a moment, after it was found free.
            links = with_port_and_key(requested, folder)
        if not up and not stopping.is_set():
            print(f"tom studio: it did not start:\n{server.tail()}", file=sys.stderr)
        yield links, server if up else None


def with_port_and_key(requested: Links, folder: str) -> Links:
    """The links `requested`, with a key and a port; a requested port must be free.

    Raises UserError if it cannot listen on its host and port.
    """
    try:
        port = _port(requested.host, requested.port)
    except OSError as error:
        raise UserError(
            f"cannot listen on --host {requested.host}: {error}; use 127.0.0.1 or an address of "
            "this machine"
        ) from error
    return replace(requested, port=port, folder=folder, key=secrets.token_urlsafe())


def _port(host: str, requested: int) -> int:
    if not requested:
        return DEFAULT_PORT if is_free(host, DEFAULT_PORT) else address.free_port(host)
    if not 1 <= requested <= 65535:
        raise UserError(f"--port {requested} is no port: use one from 1024 to 65535")
    if not is_free(host, requested):
        raise UserError(
            f"port {requested} is taken: use --port {address.free_port(host)}, or leave --port out"
        )
    return requested


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
