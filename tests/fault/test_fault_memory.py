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
    ("option", "kept"),
    [
        ("--model.hidden=10000000", None),
        ("--replay-capacity=1000000000000", None),
        ("--model.batch-size=1000000000", 40),
    ],
)
def test_settings_that_no_memory_holds__exit_1_one_line_and_the_run_up_to_its_last_checkpoint(
    tmp_path: Path, option: str, kept: int | None
):
    process = tom(*train_command(tmp_path), option, "--run-id", "a", preexec_fn=limited)
    code, _, error = ended(process)
    assert code == 1
    assert "failed: not enough memory" in one_line(error.splitlines()[-1])
    run = Store(tmp_path).run("a")
    assert run.status.state == "failed"
    assert "not enough memory" in run.status.reason
    assert run.problems == []
    assert checkpoint.newest(run.path / checkpoint.FOLDER) == kept
