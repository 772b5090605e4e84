"""Rerun's viewer may be absent, die, or never read: neither studio nor training is disturbed."""

import json
import socket
from contextlib import suppress
from pathlib import Path
from time import sleep

import pytest
from faults import config, wait_until
from kernel import descendants, megabytes
from servers import answers, command_of, studio

from tom.events import Tick
from tom.record import Store
from tom.record.recorder import Recorder
from tom.record.rerun import viewer
from tom.record.writer import RunWriter

pytestmark = pytest.mark.fault

GROWTH_MB = 60
"""what the processes may grow by while their reader does not read; the backlog is far larger"""


def write_rows(run: Path, first: int, count: int) -> None:
    """Append metric rows as a training would."""
    values = {f"model/made_up_{i}": 0.123456789 for i in range(20)}
    with (run / "metrics.jsonl").open("a") as file:
        for step in range(first, first + count):
            file.write(json.dumps({"env_step": step, **values}) + "\n")


@pytest.fixture
def growing(tmp_path: Path):
    """A run that is being written, and its recorder."""
    store = Store(tmp_path / "store")
    recorder = Recorder(RunWriter.create(store, "a", config()))
    recorder.consume(Tick(1, "explore"))
    write_rows(store.path / "a", 1, 10)
    yield store, recorder
    recorder.finish("stopped")


def watch(port: int) -> socket.socket:
    """A viewer of the run's live recording that has read its beginning."""
    watching = socket.socket()
    watching.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    watching.connect(("127.0.0.1", port))
    asked = f"GET /rrd/a/live.rrd HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\n\r\n"
    watching.sendall(asked.encode())
    assert watching.recv(1000).startswith(b"HTTP/1.1 200")
    return watching


def settled_size(pid: int) -> float:
    """Megabytes of a studio's processes, once they have stopped to grow."""
    before, now = -1.0, 0.0
    while now - before > 1:
        sleep(2)
        before, now = now, sum(map(megabytes, descendants(pid)))
    return now


def feeds(pid: int) -> list[int]:
    """The processes of a studio that make live recordings."""
    found = []
    for child in descendants(pid):
        with suppress(OSError):
            found += [child] * ("rerun.feed" in command_of(child))
    return found


@pytest.mark.quick
def test_a_rerun_that_ends_at_once__is_named_in_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(viewer, "binary", lambda: Path("/bin/true"))
    with pytest.raises(TimeoutError, match="/bin/true"):
        viewer.unpack(tmp_path / "rerun")
    assert list(tmp_path.iterdir()) == []


def test_a_viewer_that_never_reads__the_studio_does_not_grow(growing):
    store, recorder = growing
    with studio(store.path) as (process, port), watch(port):
        sizes = []
        for step in range(0, 200_000, 40_000):  # far more than sockets and pipes hold
            write_rows(store.path / "a", 11 + step, 40_000)
            recorder.beat()
            sizes.append(settled_size(process.pid))
        assert (store.path / "a" / "metrics.jsonl").stat().st_size > 80e6
        assert sizes[-1] - sizes[0] < GROWTH_MB
        assert len(feeds(process.pid)) == 1
        assert answers(port, "/api/health")


def test_a_viewer_closed_or_its_run_deleted__its_process_ends_and_the_studio_serves_on(
    growing, tmp_path: Path
):
    store, recorder = growing
    with studio(store.path) as (process, port):
        with watch(port), watch(port):
            wait_until(lambda: len(feeds(process.pid)) == 2)
        wait_until(lambda: not feeds(process.pid))  # also while nothing new comes
        with watch(port):
            (store.path / "a").rename(tmp_path / "moved")
            wait_until(lambda: not feeds(process.pid))
        assert not answers(port, "/rrd/a/live.rrd")
        assert answers(port, "/api/health")
        (tmp_path / "moved").rename(store.path / "a")
        recorder.beat()
