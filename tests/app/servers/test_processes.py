"""Servers as children: found healthy, started again, ended with all that they started."""

import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from app.servers import launcher
from app.servers.launcher import QUIET_S, RESTARTS, Restarts
from app.servers.processes import Server, free_port, is_free, stop

STUBBORN = """
import signal, subprocess, sys, time
signal.signal(signal.SIGTERM, signal.SIG_IGN)
subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"])
print("up", flush=True)
time.sleep(600)
"""


@pytest.fixture
def files(tmp_path: Path) -> Iterator[Server]:
    """A web server of files."""
    port = free_port("127.0.0.1")
    command = [sys.executable, "-m", "http.server", str(port), "--bind", "127.0.0.1"]
    server = Server("files", command, {}, "127.0.0.1", port, "/", tmp_path / "log")
    server.start()
    yield server
    stop([server])


def healthy(server: Server) -> bool:
    return server.wait_until_healthy(time.monotonic() + 30, lambda: False)


def test_a_server_is_found_healthy_and_ended(files: Server) -> None:
    assert healthy(files)
    assert not is_free("127.0.0.1", files.port)
    stop([files])
    assert not files.running
    assert is_free("127.0.0.1", files.port)


def test_a_server_that_fails_is_not_waited_for(tmp_path: Path) -> None:
    command = [sys.executable, "-c", "raise SystemExit('no such thing')"]
    server = Server("bad", command, {}, "127.0.0.1", free_port("127.0.0.1"), "/", tmp_path / "log")
    server.start()
    assert not healthy(server)
    assert server.tail() == "no such thing"
    stop([server])


def test_waiting_ends_when_the_studio_is_to_stop(files: Server) -> None:
    os.killpg(files.process.pid, signal.SIGSTOP)  # type: ignore[union-attr]
    assert not files.wait_until_healthy(time.monotonic() + 30, lambda: True)
    os.killpg(files.process.pid, signal.SIGCONT)  # type: ignore[union-attr]


def test_a_viewer_that_dies_is_started_again(files: Server) -> None:
    assert healthy(files)
    stopping = threading.Event()
    codes: list[int] = []
    watching = watcher([files], stopping, codes)
    watching.start()
    assert files.process is not None
    first = files.process.pid
    os.killpg(first, signal.SIGKILL)
    deadline = time.monotonic() + 30
    while files.process.pid == first and time.monotonic() < deadline:
        time.sleep(0.05)
    assert healthy(files)
    stopping.set()
    watching.join()
    assert codes == [0]


def watcher(servers: list[Server], stopping: threading.Event, codes: list[int]) -> threading.Thread:
    def watch() -> None:
        codes.append(launcher.watch(servers, stopping, lambda: 0.0))

    return threading.Thread(target=watch)


def test_the_pages_outlive_a_viewer_that_keeps_dying(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def server(name: str, words: str) -> Server:
        command = ["/bin/sh", "-c", words]
        return Server(name, command, {}, "127.0.0.1", 1, "/", tmp_path / f"{name}.log")

    pages, viewer = server("streamlit", "exec sleep 600"), server("viser", "echo up")
    stopping, codes = threading.Event(), []
    watching = watcher([viewer, pages], stopping, codes)
    pages.start()
    watching.start()
    said, deadline = "", time.monotonic() + 60
    while "viser" not in said and watching.is_alive() and time.monotonic() < deadline:
        time.sleep(0.05)
        said += capsys.readouterr().err
    stopping.wait(1.2)  # it looks twice more
    stopping.set()
    watching.join()
    assert pages.running
    stop([pages, viewer])
    assert codes == [0]
    assert viewer.log.read_text() == RESTARTS * "up\n"
    assert said.count("viser keeps ending") == 1
    assert capsys.readouterr().err == ""


def test_restarts_are_given_back_after_a_quiet_hour() -> None:
    restarts = Restarts()
    assert [restarts.allow("viser", now) for now in (0, 10, 20, 30)] == [True, True, True, False]
    assert restarts.allow("rerun", 30)
    assert not restarts.allow("viser", 30 + QUIET_S - 1)
    assert restarts.allow("viser", 30 + 2 * QUIET_S)
    assert all(restarts.allow("daily", day * 86_400) for day in range(10))


def test_a_stubborn_server_ends_with_its_own_children(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("app.servers.processes.STOP_GRACE_S", 0.3)
    server = Server(
        "s", [sys.executable, "-c", STUBBORN], {}, "127.0.0.1", 1, "/", tmp_path / "log"
    )
    server.start()
    deadline = time.monotonic() + 30
    while "up" not in server.tail() and time.monotonic() < deadline:
        time.sleep(0.02)
    assert server.process is not None
    group = server.process.pid
    stop([server])
    deadline = time.monotonic() + 10
    while time.monotonic() < deadline:
        try:
            os.killpg(group, 0)
        except ProcessLookupError:
            return
        time.sleep(0.05)  # the grandchild waits for init to take note of its end
    pytest.fail("a grandchild lives on")


def test_a_preferred_port_is_taken_only_when_it_is_free() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        assert not is_free("127.0.0.1", port)
        assert free_port("127.0.0.1", port) != port
    assert free_port("127.0.0.1", port) == port
