"""Damaged, foreign and strange run folders: named, and never in the way of the others."""

import builtins
import errno
import io
import json
import os
from collections.abc import Callable
from contextlib import suppress
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from faults import config, stopped
from same_records import assert_same_record

from tom.cli import main
from tom.errors import TRY_LATER, TryLaterError, UserError
from tom.policy.stored import read_policy
from tom.record import RunReader, Store, checkpoint
from tom.record.integrity import verify
from tom.training.resume import resumable_config, resume, unfinished
from tom.training.run import train

pytestmark = pytest.mark.fault


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store with a finished run and a stopped one."""
    path = tmp_path_factory.mktemp("made") / "store"
    train(config(), Store(path), "whole", rerun=True)
    stopped(Store(path), 130, "stopped")
    return path


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def problems(store: Store) -> str:
    store.runs()
    return "\n".join(store.problems)


def test_a_damaged_checkpoint__is_named_and_the_one_before_used_to_the_same_end(store: Store):
    folder = store.path / "stopped" / checkpoint.FOLDER
    newest = folder / f"{checkpoint.newest(folder):09d}"
    content = bytearray((newest / "state.pt").read_bytes())
    content[len(content) // 2] ^= 1
    (newest / "state.pt").write_bytes(content)
    done = resume(store, "stopped", rerun=False)
    assert any(newest.name in text for text in done.status.warnings)
    assert (done.path / "damaged" / checkpoint.FOLDER / newest.name).is_dir()
    assert_same_record(store.run("whole"), done)


def test_every_checkpoint_damaged__resume_is_refused_in_one_line_and_nothing_is_lost(store: Store):
    for state in (store.path / "stopped" / checkpoint.FOLDER).rglob("state.pt"):
        cut(state)
    before = store.run("stopped").metrics()
    with pytest.raises(UserError, match="no checkpoint that is whole"):
        resume(store, "stopped", rerun=False)
    pd.testing.assert_frame_equal(before, store.run("stopped").metrics())


@pytest.mark.quick
def test_a_lost_piece_of_the_buffer__verify_and_resume_say_so_and_touch_nothing(store: Store):
    (store.path / "stopped" / "buffer" / "000000000.npz").unlink()
    assert any("buffer" in problem for problem in verify(store.run("stopped")))
    before = sorted(path.name for path in (store.path / "stopped").rglob("*"))
    with pytest.raises(UserError, match="lost rows of its buffer"):
        resume(store, "stopped", rerun=False)
    assert sorted(path.name for path in (store.path / "stopped").rglob("*")) == before


def fail(
    monkeypatch: pytest.MonkeyPatch, name: str, folder: Path, fault: int, times: int = 10**6
) -> None:
    """The first `times` calls of `open` (to read) or `listdir` for what lies in `folder` fail."""
    calls = count()
    where = [os] if name == "listdir" else [io, builtins]
    really = getattr(where[0], name)

    def failing(path: str | Path | int = ".", mode: str = "r", *more: Any, **named: Any) -> object:
        inside = not isinstance(path, int) and Path(path).is_relative_to(folder)
        if inside and mode.startswith("r") and next(calls) < times:
            raise OSError(fault, os.strerror(fault), str(path))
        return really(path) if name == "listdir" else really(path, mode, *more, **named)

    for module in where:
        monkeypatch.setattr(module, name, failing)


@pytest.mark.quick
@pytest.mark.parametrize(
    ("folder", "fault"), [("buffer", errno.EIO), (checkpoint.FOLDER, errno.EACCES)]
)
def test_a_disk_that_cannot_be_read_for_now__resume_says_so_and_touches_nothing(
    store: Store, monkeypatch: pytest.MonkeyPatch, folder: str, fault: int
):
    run = store.path / "stopped"
    before = sorted(path for path in run.rglob("*") if path.is_file())
    fail(monkeypatch, "open", run / folder, fault)
    with pytest.raises(TryLaterError) as error:
        resume(store, "stopped", rerun=False)
    assert folder in str(error.value)
    assert (
        main(["train", "--resume", "stopped", "--store", str(store.path), "--no-rerun"])
        == TRY_LATER
    )
    monkeypatch.undo()
    assert sorted(path for path in run.rglob("*") if path.is_file()) == before
    assert resume(store, "stopped", rerun=False).status.state == "finished"


@pytest.mark.quick
def test_a_buffer_that_cannot_be_listed_for_now__is_not_taken_for_an_empty_one(
    store: Store, monkeypatch: pytest.MonkeyPatch
):
    fail(monkeypatch, "listdir", store.path / "stopped" / "buffer", errno.ESTALE)
    with pytest.raises(TryLaterError):
        resume(store, "stopped", rerun=False)
    monkeypatch.undo()
    assert resume(store, "stopped", rerun=False).status.state == "finished"


@pytest.mark.quick
def test_a_run_whose_checkpoints_cannot_be_read_for_now__is_not_begun_beside_itself(
    store: Store, monkeypatch: pytest.MonkeyPatch
):
    run = store.run("stopped")
    fail(monkeypatch, "open", run.path / checkpoint.FOLDER, errno.EIO)
    with pytest.raises(TryLaterError):
        unfinished(store, resumable_config(run))
    assert "cannot be read" in "\n".join(verify(run))
    assert "cannot go on" not in "\n".join(verify(run))


@pytest.mark.quick
def test_a_folder_of_a_newer_format__is_read_as_far_as_known_and_not_resumed(store: Store):
    path = store.path / "stopped" / "config.json"
    content = json.loads(path.read_text())
    content["schema"] = 2
    content["config"]["invented_later"] = 1
    path.write_text(json.dumps(content))
    run = store.run("stopped")
    assert len(run.metrics()) > 1
    assert "newer version (schema 2" in run.problems[0]
    with pytest.raises(UserError, match="made by another version"):
        resume(store, "stopped", rerun=False)


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


@pytest.mark.parametrize(
    ("name", "read"),
    [
        ("buffer/000000000.npz", RunReader.recorded),
        ("episodes/000000080.npz", lambda run: run.episodes(80)),
        ("policies/000000080.npz", lambda run: read_policy(run.path / "policies/000000080.npz")),
    ],
)
def test_a_bit_flipped_anywhere_in_a_runs_arrays__raises_no_error_but_the_users(
    store: Store, name: str, read: Callable[[RunReader], object]
):
    path = store.path / "stopped" / name
    content, rng = bytearray(path.read_bytes()), np.random.default_rng(0)
    ends = [*range(150), *range(len(content) - 150, len(content))]
    for at in {*ends, *rng.integers(0, len(content), 60).tolist()} & {*range(len(content))}:
        bit = 1 << int(rng.integers(8))
        content[at] ^= bit
        path.write_bytes(content)
        content[at] ^= bit
        with suppress(UserError):
            read(store.run("stopped"))
