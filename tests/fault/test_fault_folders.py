"""Damaged, foreign and hostile run folders: named, never in the way of the others nor executed."""

import ast
import builtins
import errno
import hashlib
import io
import json
import os
import re
from collections.abc import Callable, Iterator
from contextlib import suppress
from itertools import count
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pandas as pd
import pytest
import torch
from common import Evil, change, cut, flip
from faults import config, stopped
from same_records import assert_same_record

from tom.cli import main
from tom.data.datasets import read_dataset
from tom.errors import TRY_LATER, TryLaterError, UserError
from tom.policy.stored import read_policy
from tom.record import RunReader, Store, checkpoint
from tom.record.export import export
from tom.record.integrity import verify
from tom.reports.index import index
from tom.training.resume import find_unfinished, resumable_config, resume
from tom.training.run import train

pytestmark = pytest.mark.fault


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store with a finished run and a stopped one."""
    path = tmp_path_factory.mktemp("made") / "store"
    train(config(), Store(path), "whole", rerun=True)
    stopped(Store(path), 130, "stopped")
    return path


def problems(store: Store) -> str:
    store.runs()
    return "\n".join(store.problems)


def test_a_damaged_checkpoint__is_named_and_the_one_before_used_to_the_same_end(store: Store):
    folder = store.path / "stopped" / checkpoint.FOLDER
    newest = folder / f"{checkpoint.newest(folder):09d}"
    flip(newest / "state.pt", (newest / "state.pt").stat().st_size // 2)
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
    ("name", "folder", "fault"),
    [
        ("open", "buffer", errno.EIO),
        ("open", checkpoint.FOLDER, errno.EACCES),
        ("listdir", "buffer", errno.ESTALE),  # it is not taken for an empty one
    ],
)
def test_a_disk_that_cannot_be_read_for_now__resume_says_so_and_touches_nothing(
    store: Store, monkeypatch: pytest.MonkeyPatch, name: str, folder: str, fault: int
):
    run = store.path / "stopped"
    before = sorted(path for path in run.rglob("*") if path.is_file())
    fail(monkeypatch, name, run / folder, fault)
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
def test_a_run_whose_checkpoints_cannot_be_read_for_now__is_not_begun_beside_itself(
    store: Store, monkeypatch: pytest.MonkeyPatch
):
    run = store.run("stopped")
    fail(monkeypatch, "open", run.path / checkpoint.FOLDER, errno.EIO)
    with pytest.raises(TryLaterError):
        find_unfinished(store, resumable_config(run))
    assert "cannot be read" in "\n".join(verify(run))
    assert "cannot be resumed" not in "\n".join(verify(run))


@pytest.mark.quick
def test_a_folder_of_a_newer_format__is_read_as_far_as_known_and_not_resumed(store: Store):
    run = store.run("stopped")
    settings = run.config["config"] | {"invented_later": 1}
    change(run.path / "config.json", schema=2, config=settings)
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


# Untrusted input: nothing in checkpoints, data sets and settings is ever executed

ROOT = Path(__file__).parents[2]


MODULES = ("pickle", "dill", "cloudpickle", "joblib", "shelve", "marshal", "yaml", "jsonpickle")


def sources() -> list[Path]:
    return [path for package in ("tom", "app") for path in sorted((ROOT / package).rglob("*.py"))]


def calls(path: Path) -> Iterator[tuple[str, ast.Call]]:
    """Every call in a file, by the words it is called with."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Call):
            yield ast.unparse(node.func), node


@pytest.mark.quick
def test_the_source__unpickles_and_evaluates_nothing():
    for path in sources():
        for name, call in calls(path):
            where = f"{path.relative_to(ROOT)}:{call.lineno}"
            keywords = {word.arg: ast.unparse(word.value) for word in call.keywords}
            assert name not in ("eval", "exec", "compile", "__import__"), where
            assert name.partition(".")[0] not in MODULES, where
            if name == "torch.load":
                assert keywords.get("weights_only") == "True", where
            if name == "np.load":
                assert keywords.get("allow_pickle") == "False", where
            if name in ("pd.read_pickle", "np.memmap"):
                pytest.fail(where)
            assert keywords.get("shell", "False") == "False", where


@pytest.mark.quick
def test_code_in_a_checkpoint_with_the_right_hash__is_not_executed_and_the_one_before_is_used(
    store: Store, tmp_path: Path
):
    run = store.run("stopped")
    folder = run.path / checkpoint.FOLDER
    newest = folder / f"{checkpoint.newest(folder):09d}"
    torch.save({"training": Evil(tmp_path / "executed")}, newest / "state.pt")
    digest = hashlib.sha256((newest / "state.pt").read_bytes()).hexdigest()
    change(newest / "manifest.json", sha256=digest)
    done = resume(store, "stopped", rerun=False)
    assert done.status.state == "finished"
    assert any(newest.name in text for text in done.status.warnings)
    assert not (tmp_path / "executed").exists()


@pytest.mark.parametrize("name", ["buffer/000000000.npz", "episodes/000000080.npz", "policy.npz"])
def test_code_in_an_array_file__is_not_executed_and_the_file_named(
    store: Store, tmp_path: Path, name: str
):
    run = store.run("stopped")
    evil = np.array([Evil(tmp_path / "executed")], dtype=object)
    np.savez(run.path / name, reward_0=evil, obs=evil, weight_0=evil, env=evil)
    reader = RunReader(run.path)
    reader.buffer()
    reader.episodes(80)
    assert name == "policy.npz" or name in reader.problems[0]
    if name == "policy.npz":
        with pytest.raises(UserError, match="is not a stored policy"):
            read_policy(run.path / name)
    assert not (tmp_path / "executed").exists()


def test_a_data_set_whose_array_lies_in_another_file__is_refused_in_one_line(tmp_path: Path):
    (tmp_path / "secret").write_bytes(bytes(40))
    with h5py.File(tmp_path / "data.hdf5", "w") as file:
        where = [(str(tmp_path / "secret"), 0, 40)]
        file.create_dataset("rewards", (10,), "f4", external=where)
    with pytest.raises(UserError, match="another file"):
        read_dataset(tmp_path / "data.hdf5")


ESCAPES = "\x1b]0;owned\x07\x1b[2J\x9b31mred\r\nfake line\u202edrow"
MARKUP = (
    "<img src=x onerror=alert(1)> [x](http://evil.example) ```\n</pre><script>alert(1)</script>"
)
FORMULA = "=cmd|'/C calc'!A1"


def crafted(store: Store, words: str) -> RunReader:
    """A run whose every text is `words`."""
    run = store.run("stopped")
    keys = dict.fromkeys(("learner", "preset", "command", "git_commit"), words)
    change(run.path / "config.json", versions={words: words}, **keys)
    told = {"phase": words, "reason": words, "warnings": [words]}
    change(run.path / "status.json", state="failed", **told)
    notice = {"env_step": 1, "code": words, "message": words}
    (run.path / "notices.jsonl").write_text(json.dumps(notice) + "\n")
    with (run.path / "metrics.jsonl").open("a") as file:
        file.write(json.dumps({"env_step": 131, words: 1.0}) + "\n")
    (run.path / "labels.json").write_text(
        json.dumps({"name": words, "tags": [words], "note": words})
    )
    (store.path / f"folder {words.replace('/', '')}").mkdir()
    (run.path / "buffer" / f"0{words.replace('/', '')}.npz").touch()
    return run


@pytest.mark.quick
@pytest.mark.parametrize(
    "verb",
    [("runs", "list"), ("runs", "show", "stopped"), ("runs", "verify"), ("doctor",), ("runs",)],
)
def test_terminal_escapes_in_a_run_and_in_folder_names__are_printed_as_plain_words(
    verb: tuple[str, ...], store: Store, capsys: pytest.CaptureFixture[str]
):
    crafted(store, ESCAPES)
    main([*verb, "--store", str(store.path)])
    said = capsys.readouterr()
    for line in (said.out + said.err).split("\n"):
        assert line.isprintable(), line
        assert not line.startswith("fake line")


@pytest.mark.quick
def test_terminal_escapes_in_what_is_asked_for__are_printed_as_plain_words(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    assert main(["runs", "show", ESCAPES, "--store", str(tmp_path)]) == 2
    assert main(["runs", "list", "--store", str(tmp_path / ESCAPES.replace("/", ""))]) == 2
    assert all(line.isprintable() for line in capsys.readouterr().err.split("\n"))


@pytest.mark.quick
def test_markup_in_the_settings_of_small_copies__is_plain_words_in_the_page_about_them(
    store: Store,
):
    run = crafted(store, MARKUP)
    page = index([run], [])
    outside, inside = [], ""
    for line in page.split("\n"):
        ticks = re.match("`{3,}", line)
        if ticks and not inside:
            inside = ticks[0]
        elif inside and line.startswith(inside):
            inside = ""
        elif not inside:
            outside.append(line)
    assert not re.search(r"(?<!\\)[<\[]", "\n".join(outside))
    assert inside == ""


@pytest.mark.quick
def test_a_metric_named_as_a_formula__is_a_text_in_the_csv(store: Store, tmp_path: Path):
    run = crafted(store, FORMULA)
    table = pd.read_csv(export(run, "csv", tmp_path / "out"))
    assert "'" + FORMULA in table.columns
    assert not [name for name in table.columns if name[0] in "=+-@"]
