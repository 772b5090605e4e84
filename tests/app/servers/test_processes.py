"""Servers as children: found healthy, started again, ended with all that they started."""

import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from app.servers import launcher
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


def test_a_viewer_that_dies_is_started_again(
    files: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert healthy(files)
    monkeypatch.setattr(launcher, "LIFE_S", 0.0)
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
        codes.append(launcher.watch(servers, stopping))

    return threading.Thread(target=watch)


def test_the_pages_outlive_a_viewer_that_dies_at_once(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def server(name: str, words: str) -> Server:
        command = ["/bin/sh", "-c", words]
        return Server(name, command, {}, "127.0.0.1", 1, "/", tmp_path / f"{name}.log")

    pages, viewer = server("streamlit", "exec sleep 600"), server("viser", "echo up")
    stopping, codes = threading.Event(), []
    watching = watcher([viewer, pages], stopping, codes)
    pages.start()
    viewer.start()
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
    assert viewer.log.read_text() == "up\n"
    assert said.count("viser ended") == 1
    assert capsys.readouterr().err == ""


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
