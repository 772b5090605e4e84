"""The studio: several of them on one store, an end without orphans, and hosts that others reach."""

import signal
import socket
from contextlib import suppress
from pathlib import Path
from threading import Event

import pytest
from faults import config, wait_until
from kernel import alive, descendants
from servers import answers, command_of, studio

from app.links import Links
from app.servers import launcher
from tom.events import Metrics, Tick
from tom.record import Store
from tom.record.recorder import Recorder
from tom.record.rerun import viewer
from tom.record.writer import RunWriter
from tom.training.run import train

pytestmark = pytest.mark.fault


def test_of_two_studios_on_one_store_one_is_killed__it_leaves_no_orphan_and_the_other_serves(
    tmp_path: Path,
):
    train(config("mle"), Store(tmp_path), "mle", rerun=False)
    with studio(tmp_path) as (first, port), studio(tmp_path) as (second, other):
        assert port != other
        assert answers(port, "/api/health")
        children = {s.pid: descendants(s.pid) for s in (first, second)}
        reruns = str(viewer.binary())
        assert not [pid for pid in children[second.pid] if command_of(pid).startswith(reruns)]
        first.kill()
        first.wait()
        wait_until(lambda: not any(map(alive, children[first.pid])), seconds=20)
        assert launcher.is_free("127.0.0.1", port)
        assert answers(other, "/api/health")
        second.send_signal(signal.SIGTERM)
        assert second.wait(30) == 0
        wait_until(lambda: not any(map(alive, children[second.pid])))


@pytest.mark.quick
@pytest.mark.parametrize("host", ["127.0.0.1", "0.0.0.0"])
def test_a_host_that_others_reach__is_explicit_and_warns_before_anything_starts(
    host: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    stopping = Event()
    stopping.set()
    with launcher.serving(Links(str(tmp_path), host), stopping) as (links, running):
        assert (links.host, running) == (host, None)
        warned = "reachable from other machines" in capsys.readouterr().err
    assert warned == (host != "127.0.0.1")


# Rerun's viewer may be absent or die: neither studio nor training is disturbed


def watch(port: int) -> socket.socket:
    """A viewer of the run's live recording that has read its beginning."""
    watching = socket.socket()
    watching.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    watching.connect(("127.0.0.1", port))
    asked = f"GET /rrd/a/live.rrd HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\n\r\n"
    watching.sendall(asked.encode())
    assert watching.recv(1000).startswith(b"HTTP/1.1 200")
    return watching


def feeds(pid: int) -> list[int]:
    """The processes of a studio that make live recordings."""
    found = []
    for child in descendants(pid):
        with suppress(OSError):
            found += [child] * ("rerun.feed" in command_of(child))
    return found


def test_a_viewer_closed_or_its_run_deleted__its_process_ends_and_the_studio_serves_on(
    tmp_path: Path,
):
    store = Store(tmp_path / "store")
    with (
        Recorder(RunWriter.create(store, "a", config())) as recorder,
        studio(store.path) as (process, port),
    ):
        recorder.consume(Tick(1, "explore"))
        recorder.consume(Metrics(1, {"model/train_nll": 1.0}))
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
