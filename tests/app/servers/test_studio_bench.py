"""What `tom bench studio` is asked for, and what its rows say."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from studio_pages import in_browser

from app.servers import browser_bench
from app.servers.bench import KINDS, main, make_run
from tom.cli import bench
from tom.cli import main as tom


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


@in_browser
def test_the_bench_of_the_map_measures_a_buffer(tmp_path: Path) -> None:
    found = list(browser_bench.measure_map(tmp_path, {400: make_run(tmp_path, 400)}))
    assert len(found) == 5
    assert all(one.value > 0 and one.target is None for one in found)
