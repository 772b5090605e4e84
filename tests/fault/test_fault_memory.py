"""Not enough memory: one line, a status that says so, and the run stays."""

import resource
from pathlib import Path

import pytest
from faults import ended, one_line, tom, train_command

from tom.record import Store, checkpoint

pytestmark = pytest.mark.fault

BYTES = 8 * 10**9
"""what a training of these tests may have; it takes under one"""


def limited() -> None:
    resource.setrlimit(resource.RLIMIT_DATA, (BYTES, BYTES))


@pytest.mark.parametrize(
    "option",
    [
        "--model.hidden=10000000",
        "--replay-capacity=1000000000000",
    ],
)
def test_settings_that_no_memory_holds__exit_1_one_line_and_a_status_that_says_so(
    tmp_path: Path, option: str
):
    process = tom(*train_command(tmp_path), option, "--run-id", "a", preexec_fn=limited)
    code, _, error = ended(process)
    assert code == 1
    line = one_line(error)
    assert "failed: not enough memory" in line
    assert "smaller networks, batches or buffers" in line
    status = Store(tmp_path).run("a").status
    assert status.state == "failed"
    assert "not enough memory" in status.reason


def test_memory_that_runs_out_in_the_middle__the_run_stays_up_to_its_last_checkpoint(
    tmp_path: Path,
):
    command = [*train_command(tmp_path), "--model.batch-size=1000000000", "--run-id", "a"]
    code, _, error = ended(tom(*command, preexec_fn=limited))
    assert code == 1
    assert "failed: not enough memory" in one_line(error.splitlines()[-1])
    run = Store(tmp_path).run("a")
    assert run.status.reason.startswith("step 40: not enough memory")
    assert run.problems == []
    assert checkpoint.newest(run.path / checkpoint.FOLDER) == 40
