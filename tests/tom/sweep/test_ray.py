"""Sweeps on Ray clusters of this machine."""

import os
import secrets
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from commands import OWN_TASK, refused
from kernel import descendants
from sweeping import WAIT_S, assert_same_runs, beyond_a_checkpoint, finish, plan, until

from tom.machine.address import free_port
from tom.record import RunReader, Store
from tom.sweep.driver import Driver, FolderBackend
from tom.sweep.engine import LocalEngine

ROOT = Path(__file__).parents[3]
SMOKE = ("--env", "inverted-pendulum", "--learner", "mle", "--preset", "smoke")
RAY = (sys.executable, "-m", "ray.scripts.scripts")


def sweep(*words: str) -> list[str]:
    """Ray keeps its settings for as long as a process lives: every sweep has one of its own."""
    return [sys.executable, "-m", "tom", "sweep", *SMOKE, "--engine", "ray", *words]


@pytest.mark.slow
def test_where_no_cluster_answers_one_line_says_so_and_ray_wants_a_token(
    tmp_path: Path, capsys, monkeypatch
):
    names = ("RAY_AUTH_MODE", "RAY_USAGE_STATS_ENABLED")
    for name in names:
        monkeypatch.setenv(name, "")  # so that what is set now is put back
        monkeypatch.delenv(name)
    words = ["--engine", "ray", "--address", "127.0.0.1:9", "--store", str(tmp_path / "store")]
    refused(["sweep", *SMOKE, *words], capsys, "no Ray cluster answers there")
    assert [os.environ[name] for name in names] == ["token", "0"]
    assert not (tmp_path / "store").exists()


def test_without_ray_the_line_names_what_to_install(tmp_path: Path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    words = ["sweep", *SMOKE, "--engine", "ray", "--store", str(tmp_path / "store")]
    refused(words, capsys, 'pip install -e ".[cluster]"')


@pytest.fixture
def token(monkeypatch: pytest.MonkeyPatch) -> None:
    """What every node and whoever speaks to them must have in its environment."""
    monkeypatch.setenv("RAY_AUTH_MODE", "token")
    monkeypatch.setenv("RAY_AUTH_TOKEN", secrets.token_hex(32))
    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")


@pytest.fixture
def node(token: None) -> Iterator[Callable[..., subprocess.Popen[bytes]]]:
    """Starts nodes of one core; all end with the test."""
    with ExitStack() as stack:
        # Ray's sockets want a short path.
        folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="ray-"))

        def start(*words: str) -> subprocess.Popen[bytes]:
            own = (f"--temp-dir={folder}",) if "--head" in words else ()
            how = ("--num-cpus=1", "--object-store-memory=80000000", "--block", *own, *words)
            process = subprocess.Popen([*RAY, "start", *how], stdout=subprocess.DEVNULL)
            stack.callback(end, process)
            return process

        yield start


def end(process: subprocess.Popen[bytes]) -> None:
    """Kill a node with everything that it started, as if its machine lost power."""
    for pid in [*descendants(process.pid), process.pid]:
        try:
            os.kill(pid, signal.SIGKILL)
        except ProcessLookupError:
            continue
    process.wait()


Head = tuple[str, subprocess.Popen[bytes]]
"""the address of a cluster that is up, and the process of its head"""


@pytest.fixture
def head(node: Callable[..., subprocess.Popen[bytes]]) -> Head:
    port = free_port("127.0.0.1")
    process = node("--head", f"--port={port}", "--include-dashboard=false")
    until(lambda: len(descendants(process.pid)) > 2)
    return f"127.0.0.1:{port}", process


@pytest.mark.slow
def test_what_the_user_names_reaches_a_cluster_that_was_there_before(
    head: Head, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    (tmp_path / "own_tasks.py").write_text(OWN_TASK)
    (tmp_path / "own_learner.py").write_text("from reward import register")
    for path in (ROOT / "docs/examples").glob("*.py"):
        shutil.copy(path, tmp_path)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    words = ["--env", "own_tasks:Own-v0", "--learner", "surprise", "--preset", "smoke"]
    words += ["--plugin", "own_learner", "--plugin", "surprise.py", "--surprise.steps", "9"]
    words += ["--termination", "own_tasks:fallen", "--store", "runs", "--steps", "210"]
    command = [sys.executable, "-m", "tom", "sweep", *words, "--engine", "ray"]
    command += ["--address", head[0]]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "1 of 1 runs finished" in done.stdout


@pytest.mark.fault
def test_a_sweep_on_a_cluster_asked_to_stop__stops_with_a_checkpoint(tmp_path: Path):
    command = sweep("--steps", "100000", "--checkpoint-every", "100", "--store", str(tmp_path))
    driver = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    until(lambda: beyond_a_checkpoint(Store(tmp_path)))
    driver.send_signal(signal.SIGINT)
    out, _ = driver.communicate(timeout=WAIT_S)
    assert driver.returncode == 1
    assert "the same command continues" in out
    (run,) = Store(tmp_path).runs()
    assert run.status.state == "stopped"
    assert "stopped after" in (tmp_path / ".sweep" / f"{run.run_id}.log").read_text()


@pytest.mark.fault
def test_a_node_of_a_cluster_killed__its_runs_go_on_elsewhere_to_the_same_numbers(
    node: Callable[..., subprocess.Popen[bytes]], head: Head, tmp_path: Path
):
    store, (address, _) = Store(tmp_path / "store"), head
    other = node(f"--address={address}")
    words = ("--steps", "1500", "--checkpoint-every", "100", "--seeds", "0", "1")
    driver = subprocess.Popen(sweep(*words, "--address", address, "--store", str(store.path)))
    until(lambda: len(beyond_a_checkpoint(store)) == 2)
    lost = [run for run in store.runs() if run.status.pid in descendants(other.pid)]
    assert len(lost) == 1
    end(other)
    assert driver.wait(WAIT_S) == 0
    log = store.path / ".sweep" / f"{lost[0].run_id}.log"
    assert log.read_text().count("$ tom train") == 2
    undisturbed = Store(tmp_path / "undisturbed")
    planned = plan(learner=["mle"], steps=1500)
    finish(Driver(FolderBackend(undisturbed), planned, LocalEngine(2)))
    assert_same_runs(store, undisturbed)


@pytest.mark.fault
def test_the_head_of_a_cluster_killed__the_sweep_says_so_in_a_summary_and_can_go_on(
    head: Head, tmp_path: Path
):
    store, (address, process) = Store(tmp_path / "store"), head
    words = ("--steps", "1500", "--checkpoint-every", "100", "--store", str(store.path))
    command = sweep(*words, "--address", address)
    driver = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    until(lambda: len(beyond_a_checkpoint(store)) == 1)
    end(process)
    out, error = driver.communicate(timeout=WAIT_S)
    assert driver.returncode == 1
    assert "the head of the Ray cluster has not answered" in out
    assert "0 of 1 runs finished, 0 failed" in out
    assert "the same command continues" in out
    assert "GCS" not in out + error
    (run,) = store.runs()
    until(lambda: not RunReader(run.path).status.alive)
    done = subprocess.run(sweep(*words, "--jobs", "1"), capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    planned, undisturbed = plan(learner=["mle"], seeds=[0], steps=1500), Store(tmp_path / "other")
    finish(Driver(FolderBackend(undisturbed), planned, LocalEngine(1)))
    assert_same_runs(store, undisturbed)
