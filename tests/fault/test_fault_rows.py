"""Rows of a run that are lost, changed or replaced by another program."""

import re
import shutil
from collections.abc import Callable
from pathlib import Path

import pandas as pd
import pytest
from faults import config, one_line, stopped
from same_records import untimed

from tom.cli import main
from tom.errors import StartAgainError
from tom.record import Store, checkpoint
from tom.record.integrity import repair, verify
from tom.training.resume import resume
from tom.training.run import train

pytestmark = pytest.mark.fault

LINES = ["metrics.jsonl", "weights/profiles.jsonl"]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that finished, and one that was stopped."""
    path = tmp_path_factory.mktemp("made") / "store"
    train(config(), Store(path), "finished", rerun=False)
    stopped(Store(path), 130, "stopped")
    return path


def halved(content: bytes) -> bytes:
    lines = content.splitlines(keepends=True)
    return b"".join(lines[: len(lines) // 2])


def without_its_second_row(content: bytes) -> bytes:
    first, _, *rest = content.splitlines(keepends=True)
    return b"".join([first, *rest])


def edited(content: bytes) -> bytes:
    """The last digit of the first row is another."""
    first, *rest = content.splitlines(keepends=True)
    changed = re.sub(rb"\d(\D*)$", lambda found: b"%d" % (found[0][:1] == b"0") + found[1], first)
    return b"".join([changed, *rest])


def torn(content: bytes) -> bytes:
    return content[:-20]


DAMAGES = [halved, without_its_second_row, edited, torn]


def refused(store: Store, run_id: str, capsys: pytest.CaptureFixture[str]) -> str:
    """The one line in which a resume of the run is refused."""
    capsys.readouterr()
    command = ["train", "--resume", run_id, "--steps=300", "--no-rerun", "--store", str(store.path)]
    assert main(command) == 2
    return one_line(capsys.readouterr().err)


@pytest.mark.parametrize("damage", DAMAGES)
@pytest.mark.parametrize("name", LINES)
@pytest.mark.parametrize("run_id", ["finished", "stopped"])
def test_a_run_that_lost_rows__a_resume_is_refused_until_it_is_repaired(
    store: Store,
    run_id: str,
    name: str,
    damage: Callable[[bytes], bytes],
    capsys: pytest.CaptureFixture[str],
):
    run = store.run(run_id)
    before, path = untimed(run), run.path / name
    if run_id == "stopped":
        (run.path / "metrics.parquet").unlink()  # as of a killed run: it is written at the end
    path.write_bytes(damage(path.read_bytes()))
    assert any(name in problem for problem in verify(run))
    assert name in refused(store, run_id, capsys)
    repair(run)
    assert verify(run) == []
    after = resume(store, run_id, steps=300, rerun=False)
    assert (after.status.state, verify(after)) == ("finished", [])
    if run_id == "finished":  # the next fit adds to the row of step 240
        count = sum(step < 240 for step in before["env_step"])
        held = untimed(after).head(count)
        pd.testing.assert_frame_equal(held, before.head(count), check_like=True)


def test_a_checkpoint_of_an_earlier_version_without_digests__starts_again(store: Store):
    folder = store.path / "stopped" / checkpoint.FOLDER
    held = checkpoint.load(folder)
    assert held is not None
    del held.state["record"]["files"]["sha256"]
    checkpoint.save(folder, held.env_step, held.state)
    with pytest.raises(StartAgainError):
        resume(store, "stopped", rerun=False)


def test_a_buffer_that_was_lost__is_a_problem_of_the_checkpoint_that_counts_on_it(store: Store):
    run = store.run("stopped")
    shutil.rmtree(run.path / "buffer")
    (run.path / "buffer").mkdir()
    assert any("buffer" in problem for problem in verify(run))
