"""The page server as a child: found healthy, ended with all that it started."""

import os
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from app.links import Links
from app.servers.launcher import Server, is_free
from tom.machine.address import free_port

STUBBORN = """
import signal, subprocess, sys, time
signal.signal(signal.SIGTERM, signal.SIG_IGN)
subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"])
print("up", flush=True)
time.sleep(600)
"""


def server(folder: Path, *command: str, port: int = 1) -> Server:
    return Server(Links(port=port, folder=str(folder), key="k"), [sys.executable, *command])


@pytest.fixture
def files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Server]:
    """A web server of files, one of which says that it is this one."""
    monkeypatch.chdir(tmp_path)
    port = free_port("127.0.0.1")
    command = ("-m", "http.server", str(port), "--bind", "127.0.0.1")
    made = server(tmp_path, *command, port=port)
    (tmp_path / "api").mkdir()
    (tmp_path / "api" / "health").write_text(f"it is {made.links.launch}")
    made.start()
    yield made
    made.stop()


def healthy(server: Server, timeout_s: float = 30.0) -> bool:
    return server.wait_until_healthy(timeout_s, lambda: False)


def test_a_server_is_found_healthy_and_ended(files: Server) -> None:
    assert healthy(files)
    assert not is_free("127.0.0.1", files.links.port)
    Path("api", "health").write_text("it is another one")
    assert not healthy(files, 0.5)
    files.stop()
    assert not files.running
    assert is_free("127.0.0.1", files.links.port)


def test_a_server_that_fails_is_not_waited_for(tmp_path: Path) -> None:
    failing = server(tmp_path, "-c", "raise SystemExit('no such thing')")
    failing.start()
    assert not healthy(failing)
    assert failing.tail() == "no such thing"
    failing.stop()


def test_a_stubborn_server_ends_with_its_own_children(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("app.servers.launcher.STOP_GRACE_S", 0.3)
    stubborn = server(tmp_path, "-c", STUBBORN)
    stubborn.start()
    deadline = time.monotonic() + 30
    while "up" not in stubborn.tail() and time.monotonic() < deadline:
        time.sleep(0.02)
    assert stubborn.process is not None
    group = stubborn.process.pid
    stubborn.stop()
    deadline = time.monotonic() + 10
    while time.monotonic() < deadline:
        try:
            os.killpg(group, 0)
        except ProcessLookupError:
            return
        time.sleep(0.05)  # the grandchild waits for init to take note of its end
    pytest.fail("a grandchild lives on")
