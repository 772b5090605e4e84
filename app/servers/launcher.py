"""Start Streamlit, the Rerun hub and the viser server with their links, and end them together."""

import os
import secrets
import signal
import sys
import tempfile
import time
import webbrowser
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from threading import Event

from app.links import LOOPBACK, Links
from app.servers.processes import Server, free_port, is_free, stop
from app.theme import Mode
from tom.errors import UserError
from tom.record.rerun import hub

DEFAULT_PORT = 8600
START_TIMEOUT_S = 60.0
ATTEMPTS = 3
"""launches, each on newly found ports, before the studio gives up"""
LIFE_S = 10.0
"""a viewer that dies younger than this is not started again"""
OPEN = (
    "tom studio: reachable from other machines, without a password: runs can be read by everybody "
    "who reaches this host"
)


@dataclass(frozen=True)
class Studio:
    """The options of a studio. A given `port` must be free; by default a free one is chosen."""

    store: Path
    host: str = "127.0.0.1"
    port: int | None = None
    theme: Mode | None = None


def run(studio: Studio, *, browser: bool) -> int:
    """Serve until SIGINT or SIGTERM (returns 0), or until Streamlit fails (returns 1)."""
    stopping = Event()
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, lambda *_: stopping.set())
    with servers(studio, stopping) as (links, running):
        if stopping.is_set():
            return 0
        if running is None:
            return 1
        missing = "" if studio.store.exists() else ", which is not there yet"
        store = f"store {studio.store}{missing}"
        print(f"tom studio: {links.opened()}  ({store}; Ctrl-C stops it)", flush=True)
        if links.local_only:
            print(f"            over SSH: ssh {links.tunnels} THIS-MACHINE", flush=True)
        if browser and _has_display():
            webbrowser.open(_leading_to(links).as_uri())
        return watch(running, stopping)


@contextmanager
def servers(studio: Studio, stopping: Event) -> Iterator[tuple[Links, list[Server] | None]]:
    """The studio's healthy servers; None if they did not start."""
    started: list[Server] = []
    with tempfile.TemporaryDirectory(prefix="tom-studio-") as folder:
        try:
            links, failed = _launch(studio, Path(folder), started, stopping)
            if failed and not stopping.is_set():
                print(f"tom studio: {failed.name} did not start:\n{failed.tail()}", file=sys.stderr)
            yield links, None if failed else started
        finally:
            stop(started)


def _launch(
    studio: Studio, folder: Path, started: list[Server], stopping: Event, left: int = ATTEMPTS
) -> tuple[Links, Server | None]:
    """Start the servers, kept in `started`; their links and the first that does not answer."""
    links = plan(studio, folder)
    if studio.host not in LOOPBACK and left == ATTEMPTS:
        print(OPEN, file=sys.stderr)
    started[:] = build(links, folder)
    failed = _start(started, stopping)
    if failed and failed.port_was_taken and left > 1 and not stopping.is_set():
        # Another program took its port, if only for a moment, after it was found free.
        stop(started)
        return _launch(studio, folder, started, stopping, left - 1)
    return links, failed


def plan(studio: Studio, folder: Path) -> Links:
    """The ports of all servers. Raises UserError if a requested one is not free."""
    try:
        port = _studio_port(studio.host, studio.port)
        others = [] if studio.port is None else [port + 1, port + 2]
        for other in others:  # a given port fixes all three: for tunnels and firewalls
            _studio_port(studio.host, other)
        while len(others) < 2:
            others += {free_port(studio.host)} - {port, *others}
        rerun_port, viser_port = others
    except (OSError, OverflowError) as error:
        raise UserError(
            f"cannot listen on --host {studio.host}: {error}; use 127.0.0.1 or an address of "
            "this machine"
        ) from error
    return Links(
        store=str(studio.store),
        host=studio.host,
        port=port,
        rerun_port=rerun_port,
        viser_port=viser_port,
        control=str(folder / "control"),
        theme=studio.theme,
        key=secrets.token_urlsafe(),
    )


def build(links: Links, folder: Path) -> list[Server]:
    """The three servers, Streamlit last, because its pages refer to the others."""
    python = [sys.executable, "-m"]
    # Two arenas of memory instead of one for each thread: 60 MB less once pages were drawn.
    environment = {**links.environment(), "OMP_NUM_THREADS": "1", "MALLOC_ARENA_MAX": "2"}

    def server(name: str, command: list[str], port: int, health: str, mark: str = "") -> Server:
        log = folder / f"{name}.log"
        return Server(name, command, environment, links.local_host, port, health, log, mark)

    rerun = hub.command(links.host, links.rerun_port, links.store, links.port)
    pages = [*python, "app.servers.pages"]
    return [
        server("rerun", rerun, links.rerun_port, "/"),
        server("viser", [*python, "app.scenes.server"], links.viser_port, "/"),
        server("streamlit", pages, links.port, "/api/health", mark=links.launch),
    ]


def _studio_port(host: str, asked: int | None) -> int:
    if asked is None:
        return free_port(host, DEFAULT_PORT)
    if not 1 <= asked <= 65535:
        raise UserError(f"--port {asked} is no port: use one from 1024 to 65535")
    if not is_free(host, asked):
        raise UserError(f"port {asked} is taken: use --port {free_port(host)}, or leave --port out")
    return asked


def _start(servers: Sequence[Server], stopping: Event) -> Server | None:
    """Start them; the first that does not answer, None if all do."""
    for server in servers:
        server.start()
    deadline = time.monotonic() + START_TIMEOUT_S
    for server in servers:
        if not server.wait_until_healthy(deadline, stopping.is_set):
            return server
    return None


def watch(running: Sequence[Server], stopping: Event) -> int:
    """Wait for the end (0), or until Streamlit ends (1). Dead viewers are started again.

    A viewer that dies soon after its start is not; the pages work without it.
    """
    watched = list(running)
    while not stopping.wait(0.5):
        for server in [server for server in watched if not server.running]:
            if server.name == "streamlit":
                print(f"tom studio: {server.name} ended:\n{server.tail()}", file=sys.stderr)
                return 1
            if time.monotonic() - server.started >= LIFE_S:
                server.start()
                continue
            watched.remove(server)
            print(
                f"tom studio: {server.name} ended, so the pages go on without it; start the studio "
                f"again to have it back:\n{server.tail()}",
                file=sys.stderr,
            )
    return 0


def _leading_to(links: Links) -> Path:
    """A file that redirects to the studio, because all users can see a browser's arguments."""
    path = Path(links.control).with_name("studio.html")
    path.write_text(f'<!doctype html><script>location.replace("{links.opened()}")</script>')
    return path


def _has_display() -> bool:
    if sys.platform == "linux":
        return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
    return True
