"""Rows of a run that are lost, changed or replaced by another program."""

import shutil
from collections.abc import Callable
from pathlib import Path

import pandas as pd
import pytest
from faults import config, stopped
from same_records import untimed

from tom.record import Store
from tom.record.integrity import repair, verify
from tom.training.resume import resume
from tom.training.run import train

pytestmark = pytest.mark.fault


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


def torn(content: bytes) -> bytes:
    return content[:-20]


@pytest.mark.parametrize("damage", [halved, torn])
@pytest.mark.parametrize("name", ["metrics.jsonl", "weights/profiles.jsonl"])
def test_a_run_that_lost_rows__goes_on_and_says_so(
    store: Store, name: str, damage: Callable[[bytes], bytes]
):
    run = store.run("stopped")
    table, path = (run.path / "metrics.parquet").read_bytes(), run.path / name
    path.write_bytes(damage(path.read_bytes()))
    after = resume(store, "stopped", rerun=False)
    assert (after.status.state, verify(after)) == ("finished", [])
    assert [row["code"] for row in after.notices()].count("rows") == 1
    assert any(name in warning for warning in after.status.warnings)
    if name == "metrics.jsonl":  # the table has what its rows lost
        assert (run.path / "damaged/metrics.parquet").read_bytes() == table


@pytest.mark.parametrize("name", ["metrics.jsonl", "weights/profiles.jsonl"])
def test_lines_of_a_finished_run_that_are_damaged__are_blank_after_a_repair_and_it_goes_on(
    store: Store, name: str
):
    run = store.run("finished")
    before, path = untimed(run), run.path / name
    first, *rest = path.read_bytes().splitlines(keepends=True)
    path.write_bytes(b"".join([b"x" * (len(first) - 1) + b"\n", *rest]))
    assert any(name in problem for problem in verify(run))
    repair(run)
    assert verify(run) == []
    after = resume(store, "finished", steps=300, rerun=False)
    assert (after.status.state, verify(after)) == ("finished", [])
    if name != "metrics.jsonl":
        count = sum(step < 240 for step in before["env_step"])  # the next fit adds to step 240's
        held = untimed(after).head(count)
        pd.testing.assert_frame_equal(held, before.head(count), check_like=True)


def test_a_buffer_that_was_lost__is_a_problem_of_the_checkpoint_that_counts_on_it(store: Store):
    run = store.run("stopped")
    shutil.rmtree(run.path / "buffer")
    (run.path / "buffer").mkdir()
    assert any("buffer" in problem for problem in verify(run))
