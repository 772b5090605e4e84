"""The store that `tom bench studio` measures with, and what its rows say."""

import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from app.data import readers
from app.servers import browser_bench
from app.servers.bench import (
    KINDS,
    METRICS,
    POINTS,
    main,
    make_run,
    make_store,
)
from tom.cli import bench
from tom.cli import main as tom


@pytest.mark.slow
def test_the_store_is_as_large_as_the_measurement_says(tmp_path: Path) -> None:
    make_store(tmp_path, len(KINDS) + 2)
    listing = readers.listing(str(tmp_path))
    assert listing.problems == ()
    assert {(run.env, run.learner, run.seed) for run in listing.runs} == {
        *((env, learner, 0) for env, learner, _ in KINDS),
        *((env, learner, 1) for env, learner, _ in KINDS[:2]),
    }
    for run in listing.runs:
        assert readers.metrics(run).shape == (POINTS, METRICS + 1)
        assert len(readers.profiles(run).env_step) == POINTS
        assert readers.problems(run) == []


def test_the_number_of_runs_reaches_the_measurement(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(bench, "exec_module", lambda _, words: main(words))
    with pytest.raises(SystemExit) as ended:
        tom(["bench", "studio", "--runs", "2", "--json"])
    assert ended.value.code == 2
    assert f"--runs 2: at least {len(KINDS)}" in capsys.readouterr().err


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_memory_and_processor_seconds_are_those_of_all_processes_below() -> None:
    child = (
        "import time; held = bytearray(b'x') * 10**8; sum(range(10**7)); print(1); time.sleep(99)"
    )
    parent = f"import subprocess, sys; subprocess.run([sys.executable, '-c', {child!r}])"
    command = [sys.executable, "-c", parent]
    with subprocess.Popen(command, stdout=subprocess.PIPE, start_new_session=True) as process:
        assert process.stdout is not None
        process.stdout.readline()
        assert 100 < browser_bench.memory_mb(process.pid) < 150
        assert browser_bench.processor_s(process.pid) > 0.05
        os.killpg(process.pid, signal.SIGKILL)


@pytest.mark.browser
@pytest.mark.skipif(shutil.which("chromium") is None, reason="needs Debian's chromium")
def test_the_bench_of_the_map_measures_a_buffer(tmp_path: Path) -> None:
    found = list(browser_bench.measure_map(tmp_path, {400: make_run(tmp_path, 400)}))
    assert len(found) == 5
    assert all(one.value > 0 and one.target is None for one in found)
