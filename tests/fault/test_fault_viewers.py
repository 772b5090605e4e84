"""The Rerun hub and its viewers may be absent, die, or never read: no training notices."""

import json
import os
import socket
import subprocess
import time
from pathlib import Path

import pytest
from faults import config, ended, tom, train_command, wait_until
from kernel import megabytes
from servers import answers, is_taken, live_hub

from tom.events import Event, Tick
from tom.record import RunReader, Store
from tom.record.recorder import Recorder
from tom.record.rerun import hub
from tom.record.writer import RunWriter
from tom.training.run import train

pytestmark = pytest.mark.fault

GROWTH_MB = 60
"""what a process may grow by while its reader does not read; the backlog is far larger"""


def write_rows(run: Path, first: int, count: int) -> int:
    """Append metric rows as a training would; the bytes written."""
    values = {f"model/made_up_{i}": 0.123456789 for i in range(20)}
    with (run / "metrics.jsonl").open("a") as file:
        for step in range(first, first + count):
            file.write(json.dumps({"env_step": step, **values}) + "\n")
        return file.tell()


@pytest.fixture
def growing(tmp_path: Path):
    """A run that is being written, and its recorder."""
    store = Store(tmp_path / "store")
    recorder = Recorder(RunWriter.create(store, "a", config()))
    recorder.consume(Tick(1, "explore"))
    write_rows(store.path / "a", 1, 10)
    yield store, recorder
    recorder.finish("stopped")


def test_a_hub_killed_under_a_training__the_training_ends_as_if_there_had_been_none(
    tmp_path: Path,
):
    with live_hub(tmp_path) as (process, _):

        def kill_hub(event: Event) -> None:
            if event == Tick(120, "optimise"):
                process.kill()

        run = train(config(), Store(tmp_path), "a", rerun=True, watchers=(kill_hub,))
        assert run.status.state == "finished"
        assert run.problems == []


@pytest.mark.quick
def test_a_rerun_that_ends_at_once__is_named_in_an_error(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(hub, "binary", lambda: Path("/bin/true"))
    with pytest.raises(TimeoutError):
        hub.viewer_files()


either = pytest.mark.parametrize("path", ["/live/a.rrd", "/live.rrd"])


@either
def test_a_viewer_that_never_reads__the_hub_does_not_grow(path: str, growing):
    store, recorder = growing
    with live_hub(store.path) as (process, port), socket.socket() as viewer:
        viewer.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        viewer.connect(("127.0.0.1", port))
        request = f"GET {path} HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\n\r\n"
        viewer.sendall(request.encode())
        write_rows(store.path / "a", 11, 40_000)  # far more than sockets hold
        recorder.beat()
        time.sleep(6)
        before, step = megabytes(process.pid), 50_000
        for _ in range(4):
            write_rows(store.path / "a", step, 40_000)
            step += 40_000
            recorder.beat()
            time.sleep(1.5)
        assert (store.path / "a" / "metrics.jsonl").stat().st_size > 80e6
        assert megabytes(process.pid) - before < GROWTH_MB
        assert answers(port)


@either
def test_a_browser_closed_in_the_middle_of_a_recording__the_hub_lets_go_and_serves_the_next(
    path: str, growing
):
    store, recorder = growing
    write_rows(store.path / "a", 11, 5_000)
    recorder.beat()
    with live_hub(store.path) as (process, port):
        for _ in range(5):
            with socket.create_connection(("127.0.0.1", port)) as viewer:
                head = f"GET {path} HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\n\r\n"
                viewer.sendall(head.encode())
                assert viewer.recv(1000).startswith(b"HTTP/1.0 200")
        wait_until(lambda: open_streams(port) == 0)
        assert process.poll() is None
        assert answers(port)


def test_a_browser_closed_while_nothing_trains__the_hub_lets_go(tmp_path: Path):
    with live_hub(tmp_path) as (_, port):
        with socket.create_connection(("127.0.0.1", port)) as viewer:
            viewer.sendall(f"GET /live.rrd HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\n\r\n".encode())
            assert viewer.recv(1000).startswith(b"HTTP/1.0 200")
            assert open_streams(port) == 1
        wait_until(lambda: open_streams(port) == 0)


def open_streams(port: int) -> int:
    """Connections that a server on `port` has not closed, those too whose other end has."""
    lines = [line.split() for line in Path("/proc/net/tcp").read_text().splitlines()[1:]]
    return sum(f[1].endswith(f":{port:04X}") and f[3] in ("01", "08") for f in lines)


def test_a_run_deleted_while_the_hub_shows_it__the_hub_goes_on_with_the_others(tmp_path: Path):
    store = Store(tmp_path / "store")
    recorders = [Recorder(RunWriter.create(store, name, config())) for name in ("a", "b")]
    for name in ("a", "b"):
        write_rows(store.path / name, 1, 10)
    with live_hub(store.path) as (process, port):
        time.sleep(2)
        (store.path / "a").rename(tmp_path / "moved")
        recorders[1].beat()
        time.sleep(3)
        assert process.poll() is None
        assert answers(port)
        assert not answers(port, "/live/a.rrd")
    recorders[1].finish("finished")
    assert store.run("b").status.state == "finished"


def test_the_hubs_port_is_taken__it_ends_with_an_error_and_takes_no_other(tmp_path: Path):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        command = hub.command("127.0.0.1", taken.getsockname()[1], tmp_path)
        process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
        _, error = process.communicate(timeout=60)
        assert process.returncode != 0
        assert "in use" in error
        assert is_taken(taken.getsockname()[1])


def test_a_training_with_rerun_whose_recording_is_a_pipe_nobody_reads__ends_all_the_same(
    tmp_path: Path,
):
    command = [part for part in train_command(tmp_path) if part != "--no-rerun"]
    code, _, error = ended(tom(*command, "--run-id", "a"))
    assert code == 0, error
    run = RunReader(tmp_path / "a")
    first = run.rrd_files()[0]
    first.unlink()
    os.mkfifo(run.path / "run.rrd")
    code, _, error = ended(
        tom("train", "--resume", "a", "--store", tmp_path, "--steps", 280), timeout_s=120
    )
    assert code == 0, error
    assert RunReader(tmp_path / "a").status.env_step == 280
