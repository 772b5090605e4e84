"""The Rerun hub and its viewers may be absent, die, or never read: no training notices."""

import json
import os
import signal
import socket
import subprocess
import threading
import time
from pathlib import Path

import pytest
from faults import config, ended, tom, train_command, wait_until
from kernel import descendants, megabytes
from rerun.chunk import RrdReader
from servers import answers, is_taken, live_hub

from tom.events import Event, Tick
from tom.record import RunReader, RunWriter, Store
from tom.record.recorder import Recorder
from tom.record.rerun import hub
from tom.record.rerun.feed import Feeder
from tom.record.rerun.hub import binary, free_port, without_analytics
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


def shown(path: Path, metric: str) -> int:
    """Values of a metric in a file that a hub may still be writing."""
    try:
        chunks = [c for c in RrdReader(path).stream() if c.entity_path == f"/{metric}"]
    except (OSError, RuntimeError):
        return 0
    return sum(chunk.to_record_batch().num_rows for chunk in chunks)


def until_full(pid: int, run: Path, recorder: Recorder) -> int:
    """Write until what Rerun lets wait is full, so that the process stands still; the next step."""
    step, seen = 11, [0.0]
    while len(seen) < 4 or seen[-1] - seen[-4] > 1:
        assert len(seen) < 20, f"it goes on growing: {seen}"
        write_rows(run, step, 20_000)
        step += 20_000
        recorder.beat()
        time.sleep(3)
        seen.append(megabytes(pid))
    return step


@pytest.fixture
def growing(tmp_path: Path):
    """A run that is being written, and its recorder."""
    store = Store(tmp_path / "store")
    recorder = Recorder(RunWriter.create(store, "a", config()))
    recorder.consume(Tick(1, "explore"))
    write_rows(store.path / "a", 1, 10)
    yield store, recorder
    recorder.finish("stopped")


@pytest.mark.quick
def test_no_hub_anywhere__training_and_feeder_do_not_care(tmp_path: Path):
    store = Store(tmp_path)
    feeder = Feeder(store, "127.0.0.1", free_port("127.0.0.1"))
    assert not feeder.hub_answers()
    stopping = threading.Event()
    feeding = threading.Thread(target=feeder.run, args=(stopping,))
    feeding.start()
    run = train(config(steps=60), store, "a", rerun=True)
    stopping.set()
    feeding.join(10)
    assert not feeding.is_alive()
    assert run.status.state == "finished"
    assert not any(notice["kind"] == "rerun" for notice in run.notices())


def test_a_hub_killed_and_restarted_mid_run__the_run_is_shown_again_from_its_beginning(
    growing, tmp_path: Path
):
    store, recorder = growing
    port, environment = free_port("127.0.0.1"), without_analytics(tmp_path)

    def start(saved: Path) -> subprocess.Popen[bytes]:
        command = [str(binary()), "--bind", "127.0.0.1", "--port", str(port), "--save", str(saved)]
        return subprocess.Popen(command, env=environment, stderr=subprocess.DEVNULL)

    stopping, feeder = threading.Event(), Feeder(store, "127.0.0.1", port)
    feeding = threading.Thread(target=feeder.run, args=(stopping,), daemon=True)
    first = start(tmp_path / "first.rrd")
    wait_until(feeder.hub_answers)
    feeding.start()
    wait_until(lambda: feeder.followed == ["a"])
    first.kill()
    first.wait()
    write_rows(store.path / "a", 11, 10)
    wait_until(lambda: feeder.followed == [])
    second = start(tmp_path / "second.rrd")
    wait_until(lambda: feeder.followed == ["a"])
    recorder.finish("finished")
    wait_until(lambda: feeder.followed == [])
    wait_until(lambda: shown(tmp_path / "second.rrd", "model/made_up_19") == 20)
    stopping.set()
    second.terminate()
    second.wait()
    feeding.join(10)


def test_a_hub_killed_under_a_training__the_training_ends_as_if_there_had_been_none(
    tmp_path: Path,
):
    with live_hub(tmp_path) as (process, _, _):

        def kill_hub(event: Event) -> None:
            if event == Tick(120, "optimise"):
                process.kill()

        run = train(config(), Store(tmp_path), "a", rerun=True, watchers=(kill_hub,))
        assert run.status.state == "finished"
        assert run.problems == []


def test_a_hub_whose_rerun_dies__ends_with_code_1_for_its_launcher_to_start_it_again(
    tmp_path: Path,
):
    tmp_path.joinpath("store").mkdir()
    with live_hub(tmp_path / "store") as (process, _, _):
        [rerun] = descendants(process.pid)
        os.kill(rerun, signal.SIGKILL)
        assert process.wait(20) == 1


def test_a_viewer_that_never_reads__the_hub_does_not_grow(growing):
    store, recorder = growing
    with live_hub(store.path) as (process, _, web_port), socket.socket() as viewer:
        viewer.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        viewer.connect(("127.0.0.1", web_port))
        request = f"GET /live/a.rrd HTTP/1.1\r\nHost: 127.0.0.1:{web_port}\r\n\r\n"
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
        assert answers(web_port)


def test_a_hub_that_never_reads__its_feeder_does_not_grow_and_the_training_does_not_wait(
    growing, tmp_path: Path
):
    store, recorder = growing
    with live_hub(store.path) as (process, *_):
        [rerun] = descendants(process.pid)
        time.sleep(2)  # the run is being shown
        os.kill(rerun, signal.SIGSTOP)
        try:
            step = until_full(process.pid, store.path / "a", recorder)
            before = megabytes(process.pid)
            for _ in range(4):
                write_rows(store.path / "a", step, 40_000)
                step += 40_000
                begun = time.monotonic()
                recorder.consume(Tick(step, "explore"))
                recorder.beat()
                assert time.monotonic() - begun < 2
                time.sleep(1.5)
            assert megabytes(process.pid) - before < GROWTH_MB
        finally:
            os.kill(rerun, signal.SIGCONT)


def test_a_browser_closed_in_the_middle_of_a_recording__the_hub_lets_go_and_serves_the_next(
    growing,
):
    store, recorder = growing
    write_rows(store.path / "a", 11, 5_000)
    recorder.beat()
    with live_hub(store.path) as (process, _, web_port):
        for _ in range(5):
            with socket.create_connection(("127.0.0.1", web_port)) as viewer:
                head = f"GET /live/a.rrd HTTP/1.1\r\nHost: 127.0.0.1:{web_port}\r\n\r\n"
                viewer.sendall(head.encode())
                assert viewer.recv(1000).startswith(b"HTTP/1.0 200")
        open_files = Path(f"/proc/{process.pid}/fd")

        def streams() -> int:
            tables = ("tcp", "tcp6")
            lines = [x for t in tables for x in Path(f"/proc/net/{t}").read_text().splitlines()]
            mine = f":{web_port:04X} "
            return sum(mine in line.split(" 00000000")[0] and " 01 " in line for line in lines)

        wait_until(lambda: streams() == 0)
        assert len(list(open_files.iterdir())) > 0
        assert answers(web_port)


def test_a_run_deleted_while_the_hub_shows_it__the_hub_goes_on_with_the_others(tmp_path: Path):
    store = Store(tmp_path / "store")
    recorders = [Recorder(RunWriter.create(store, name, config())) for name in ("a", "b")]
    for name in ("a", "b"):
        write_rows(store.path / name, 1, 10)
    with live_hub(store.path) as (process, _, web_port):
        time.sleep(2)
        (store.path / "a").rename(tmp_path / "moved")
        recorders[1].beat()
        time.sleep(3)
        assert process.poll() is None
        assert answers(web_port)
        assert not answers(web_port, "/live/a.rrd")
    recorders[1].finish("finished")
    assert store.run("b").status.state == "finished"


def test_the_hubs_port_is_taken__it_ends_with_an_error_and_takes_no_other(tmp_path: Path):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        command = hub.command("127.0.0.1", free_port("127.0.0.1"), taken.getsockname()[1], tmp_path)
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
