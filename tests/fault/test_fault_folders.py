"""Damaged, foreign and strange run folders: named, and never in the way of the others."""

import errno
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import suppress
from itertools import count
from pathlib import Path
from threading import Event as Flag

import numpy as np
import pandas as pd
import pytest
from faults import config, stopped
from same_records import assert_same_record

from app.parts import shortlinks
from tom.cli import main
from tom.errors import TRY_LATER, TryLaterError, UserError
from tom.record import RunReader, Store, checkpoint, layout
from tom.record.export import export_small
from tom.record.integrity import repair, verify
from tom.record.manage import restore, trash
from tom.record.rerun.feed import stream
from tom.training.resume import recorded_config, resume, unfinished
from tom.training.run import train

pytestmark = pytest.mark.fault


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store with a finished run and a stopped one."""
    path = tmp_path_factory.mktemp("made") / "store"
    train(config(), Store(path), "whole", rerun=True)
    stopped(Store(path), 130, "stopped")
    return path


@pytest.fixture
def store(made: Path, tmp_path: Path) -> Store:
    return Store(shutil.copytree(made, tmp_path / "store"))


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def problems(store: Store) -> str:
    store.runs()
    return "\n".join(store.problems)


@pytest.mark.quick
def test_half_a_json_line__is_skipped_by_readers_and_cut_off_by_resume(store: Store):
    path = store.path / "stopped"
    rows = len(store.run("stopped").metrics())
    for name in ("metrics.jsonl", "notices.jsonl", "weights/profiles.jsonl"):
        with (path / name).open("ab") as file:
            file.write(b'{"env_step":131,"critic/lo')
    run = store.run("stopped")
    assert len(run.metrics()) == rows
    run.profiles()
    run.notices()
    assert len(run.problems) == 3
    assert all("half written" in problem for problem in run.problems)
    assert_same_record(store.run("whole"), resume(store, "stopped", rerun=False))


@pytest.mark.quick
def test_a_truncated_recording__is_left_alone_and_made_again_from_the_files(store: Store):
    run = store.run("whole")
    [recording] = run.rrd_files()
    size = recording.stat().st_size
    cut(recording)
    assert len(run.metrics()) > 3
    assert run.problems == []
    assert sum(map(len, stream(run, Flag()))) > size / 4
    longer = resume(store, "whole", steps=280, rerun=True)
    assert [path.name for path in longer.rrd_files()] == ["run.rrd", "run-2.rrd"]


@pytest.mark.quick
def test_a_truncated_weights_file__is_named_and_the_rest_is_read(store: Store):
    run = store.run("whole")
    first, *others = run.snapshot_steps()
    cut(run.path / "weights" / f"snapshot-{first:09d}.parquet")
    assert len(run.snapshot(first)) == 0
    assert all(len(run.snapshot(step)) for step in others)
    assert run.problems[0].startswith(f"weights/snapshot-{first:09d}.parquet cannot be read")


@pytest.mark.parametrize("damage", ["truncated", "flipped", "without manifest", "newer format"])
def test_a_damaged_checkpoint__is_named_and_the_one_before_used_to_the_same_end(
    store: Store, damage: str
):
    folder = store.path / "stopped" / checkpoint.FOLDER
    newest = folder / f"{checkpoint.newest(folder):09d}"
    content = (newest / "state.pt").read_bytes()
    match damage:
        case "truncated":
            cut(newest / "state.pt")
        case "flipped":
            middle = len(content) // 2
            flipped = bytes([content[middle] ^ 1])
            (newest / "state.pt").write_bytes(content[:middle] + flipped + content[middle + 1 :])
        case "without manifest":
            (newest / "manifest.json").unlink()
        case _:
            (newest / "manifest.json").write_text('{"schema": 99}')
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


def test_a_checkpoint_that_fits_another_training__is_refused_in_one_line(
    store: Store, tmp_path: Path
):
    other = stopped(Store(tmp_path / "other"), 130, env="hopper")
    folder = store.path / "stopped" / checkpoint.FOLDER
    shutil.rmtree(folder)
    shutil.copytree(other.path / checkpoint.FOLDER, folder)
    with pytest.raises(UserError, match="is of env hopper, not inverted-pendulum") as error:
        resume(store, "stopped", rerun=False)
    assert "\n" not in str(error.value)


@pytest.mark.quick
def test_a_lost_piece_of_the_buffer__resume_says_so_and_touches_nothing(store: Store):
    (store.path / "stopped" / "buffer" / "000000000.npz").unlink()
    before = sorted(path.name for path in (store.path / "stopped").rglob("*"))
    with pytest.raises(UserError, match="lost rows of its buffer"):
        resume(store, "stopped", rerun=False)
    assert sorted(path.name for path in (store.path / "stopped").rglob("*")) == before


def fail(
    monkeypatch: pytest.MonkeyPatch, name: str, folder: Path, fault: int, times: int = 10**6
) -> None:
    """The first `times` calls of `os.open` or `os.listdir` for what lies in `folder` fail."""
    really, calls = getattr(os, name), count()

    def failing(path: str | Path = ".", *more: int) -> object:
        writes = bool(more) and more[0] & os.O_CREAT
        if Path(path).is_relative_to(folder) and not writes and next(calls) < times:
            raise OSError(fault, os.strerror(fault), str(path))
        return really(path, *more)

    monkeypatch.setattr(os, name, failing)


@pytest.mark.quick
@pytest.mark.parametrize("folder", ["buffer", checkpoint.FOLDER])
@pytest.mark.parametrize("fault", [errno.EIO, errno.EACCES])
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
def test_checkpoints_that_could_not_be_read_a_moment_ago__are_not_taken_for_lost(
    store: Store, monkeypatch: pytest.MonkeyPatch
):
    folder = store.path / "stopped" / checkpoint.FOLDER
    fail(monkeypatch, "open", folder, errno.EIO, times=len(checkpoint.folders(folder)))
    with pytest.raises(TryLaterError):
        resume(store, "stopped", rerun=False)


@pytest.mark.quick
def test_a_run_whose_checkpoints_cannot_be_read_for_now__is_not_begun_beside_itself(
    store: Store, monkeypatch: pytest.MonkeyPatch
):
    run = store.run("stopped")
    fail(monkeypatch, "open", run.path / checkpoint.FOLDER, errno.EIO)
    with pytest.raises(TryLaterError):
        unfinished(store, recorded_config(run))
    assert "cannot be read: " in "\n".join(verify(run))
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


def test_a_folder_of_an_older_format__is_read_with_defaults_and_not_resumed(store: Store):
    path = store.path / "stopped" / "config.json"
    content = json.loads(path.read_text())
    for name in ("machine", "matmul", "preset", "git_commit", "created", "versions"):
        del content[name]
    content["schema"] = 0
    content["config"]["fit_each"] = content["config"].pop("fit_every")
    path.write_text(json.dumps(content))
    (store.path / "stopped" / "status.json").write_text('{"state": "stopped", "env_step": 130}')
    run = store.run("stopped")
    assert run.status.state == "stopped"
    assert len(run.metrics()) > 1
    assert len(store.runs()) == 2
    with pytest.raises(UserError, match="made by another version"):
        resume(store, "stopped", rerun=False)


@pytest.mark.quick
def test_folders_that_are_no_runs__are_named_and_the_others_listed(store: Store, tmp_path: Path):
    (store.path / "empty").mkdir()
    foreign = store.path / "foreign"
    foreign.mkdir()
    (foreign / "config.json").write_text('{"architectures": ["Bert"]}')
    (foreign / "model.safetensors").write_bytes(bytes(100))
    (store.path / "list").mkdir()
    (store.path / "list" / "config.json").write_text("[1, 2]")
    (tmp_path / "outside").mkdir()
    (store.path / "link").symlink_to(tmp_path / "outside")
    (store.path / "loop").symlink_to(store.path)
    (store.path / "a file").write_text("x")
    assert {run.run_id for run in store.runs()} == {"whole", "stopped"}
    for name in ("empty: no run", "foreign: no run", "list: no run", "'link' is a link", "'loop'"):
        assert name in problems(store)
    for name in ("empty", "foreign", "list", "link", "loop"):
        with pytest.raises(UserError):
            trash(store, name)
        with pytest.raises(UserError):
            resume(store, name, rerun=False)
    assert {p.name for p in store.path.iterdir()} >= {"empty", "foreign", "list", "link", "loop"}


@pytest.mark.quick
@pytest.mark.parametrize("part", ["buffer", "weights", "checkpoint", "metrics.jsonl", ".writer"])
def test_a_part_of_a_run_that_links_out_of_the_store__is_neither_read_nor_written_through(
    store: Store, tmp_path: Path, part: str
):
    inside, outside = store.path / "stopped" / part, tmp_path / "outside"
    (store.path / "stopped" / "metrics.parquet").unlink()
    inside.rename(outside)
    inside.symlink_to(outside)
    before = {p: p.read_bytes() for p in (outside, *outside.rglob("*")) if p.is_file()}
    with pytest.raises(UserError, match="link"):
        resume(store, "stopped", rerun=False)
    run = store.run("stopped")
    run.metrics()
    run.buffer()
    assert part in ("checkpoint", ".writer", "weights") or "leads out" in run.problems[0]
    assert {p: p.read_bytes() for p in (outside, *outside.rglob("*")) if p.is_file()} == before


@pytest.mark.quick
@pytest.mark.parametrize("run_id", ["..", "../store", "/etc", ".trash", "a/../whole", "whole/"])
def test_trash_of_what_is_no_run_of_the_store__is_refused_and_nothing_moves(
    store: Store, run_id: str
):
    before = sorted(store.path.rglob("*"))
    with pytest.raises(UserError):
        trash(store, run_id)
    with pytest.raises(UserError):
        restore(store, run_id)
    assert sorted(store.path.rglob("*")) == before


def test_trash_behind_a_link__is_refused_and_nothing_leaves_the_store(store: Store, tmp_path: Path):
    (tmp_path / "elsewhere").mkdir()
    (store.path / ".trash").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(UserError, match="link"):
        trash(store, "whole")
    assert not list((tmp_path / "elsewhere").iterdir())
    assert store.run("whole").status.state == "finished"


COUNT_OPENED = """
import collections, json, pathlib, sys
from tom.cli import main

opened = collections.Counter()

def watch(event, words):
    if event == "open" and "/run-" in str(words[0]):
        opened[pathlib.Path(words[0]).name] += 1

sys.addaudithook(watch)
main(sys.argv[1:])
print(json.dumps(opened))
"""
"""runs the command that its words name, and prints how often it opened which file of a run"""


def test_a_thousand_run_folders__are_all_listed_and_each_file_of_them_read_once(
    made: Path, tmp_path: Path
):
    path = tmp_path / "many"
    for number in range(1000):
        folder = path / f"run-{number:04d}"
        folder.mkdir(parents=True)
        for name in ("config.json", "status.json", "metrics.jsonl"):
            os.link(made / "whole" / name, folder / name)
    assert len(Store(path).runs()) == 1000
    counting = [sys.executable, "-c", COUNT_OPENED, "runs", "list", "--json", "--store", path]
    done = subprocess.run(counting, capture_output=True, text=True, check=True)
    listed, opened = map(json.loads, done.stdout.splitlines())
    assert len(listed) == 1000
    assert set(opened) <= {"config.json", "status.json", "labels.json"}
    assert set(opened.values()) == {1000}


def test_metrics_of_200_megabytes__are_read_whole_in_bounded_memory(store: Store):
    run = store.run("whole")
    (run.path / "metrics.parquet").unlink()
    lines = (run.path / "metrics.jsonl").read_bytes().splitlines()
    row = json.loads(max(lines, key=len))
    count = 200_000_000 // len(json.dumps(row))
    with (run.path / "metrics.jsonl").open("w") as file:
        for step in range(1, count + 1):
            file.write(json.dumps({**row, "env_step": step}) + "\n")
            if step == 5:
                file.write("damaged\n")
        file.write('{"env_step": ')
    table = run.metrics()
    assert table["env_step"].tolist() == list(range(1, count + 1))
    known = {name: value for name, value in row.items() if value is not None}
    np.testing.assert_allclose(table.iloc[-1][list(known)][1:], list(known.values())[1:])
    assert run.problems == [
        "metrics.jsonl: line 6 is damaged and was skipped",
        "metrics.jsonl: the last line is half written and was skipped",
    ]


@pytest.mark.quick
def test_a_large_metrics_file__is_the_same_table_as_row_by_row(
    store: Store, monkeypatch: pytest.MonkeyPatch
):
    run = store.run("whole")
    (run.path / "metrics.parquet").unlink()
    by_row = run.metrics()
    monkeypatch.setattr("tom.record.rows.LARGE_BYTES", 0)
    pd.testing.assert_frame_equal(by_row, run.metrics(), check_like=True)
    with (run.path / "metrics.jsonl").open("a") as file:
        file.write('{"env_step": 999, "critic/loss": "a word"}\n[1]\n{"no": 1}\n')
    odd = RunReader(run.path)
    assert odd.metrics()["env_step"].tolist() == [*by_row["env_step"], 999]
    assert "is damaged and was skipped" in odd.problems[0]


@pytest.fixture
def hurry() -> Iterator[None]:
    """Whoever opens a pipe that nobody writes is interrupted."""

    def late(*_: object) -> None:
        raise AssertionError("held up by a pipe")

    before = signal.signal(signal.SIGALRM, late)
    signal.alarm(60)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


@pytest.mark.quick
@pytest.mark.parametrize(
    "name",
    [
        "config.json",
        "status.json",
        "labels.json",
        "metrics.jsonl",
        "metrics.parquet",
        "notices.jsonl",
        "weights/profiles.jsonl",
        "buffer/000000000.npz",
        "checkpoint/000000130/manifest.json",
        "checkpoint/000000130/state.pt",
        ".writer",
    ],
)
def test_a_pipe_in_place_of_a_file__holds_nobody_up_and_is_named(
    store: Store, name: str, hurry: None, capsys: pytest.CaptureFixture[str]
):
    path = store.path / "stopped" / name
    path.unlink(missing_ok=True)
    os.mkfifo(path)
    where = ["--store", str(store.path)]
    assert main(["runs", "list", *where]) == 0
    assert "whole" in capsys.readouterr().out
    assert main(["runs", "verify", *where]) == (name != ".writer")
    said = capsys.readouterr().out
    assert (path.parent.name if "checkpoint" in name else name) in said or name == ".writer"
    with suppress(UserError):
        resume(store, "stopped", rerun=False)
    if path.suffix == ".jsonl" or name == ".writer":
        with pytest.raises(UserError, match="is no file"):
            resume(store, "stopped", rerun=False)


@pytest.mark.quick
@pytest.mark.parametrize("name", ["config.json", "status.json", "metrics.jsonl", "labels.json"])
def test_a_socket_in_place_of_a_file__is_named(
    store: Store, name: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    run = store.path / "stopped"
    (run / name).unlink(missing_ok=True)
    monkeypatch.chdir(run)  # the path of a socket may have 108 characters
    with socket.socket(socket.AF_UNIX) as one:
        one.bind(name)
    where = ["--store", str(store.path)]
    assert main(["runs", "list", *where]) == 0
    assert "whole" in capsys.readouterr().out
    assert main(["runs", "verify", *where]) == 1
    assert name in capsys.readouterr().out


@pytest.mark.quick
def test_a_pipe_in_place_of_the_page_about_small_copies__is_named(
    store: Store, hurry: None, capsys: pytest.CaptureFixture[str], tmp_path: Path
):
    out = tmp_path / "out"
    export_small(store.run("whole"), out)
    os.mkfifo(out / "README.md")
    assert main(["runs", "index", "--store", str(out)]) == 2
    error = capsys.readouterr().err
    assert "README.md cannot be read (it is no file): move it away" in error
    assert error.count("\n") == 1


@pytest.mark.quick
def test_a_pipe_in_place_of_a_short_link__leads_nowhere(store: Store, hurry: None):
    code = shortlinks.save(store.path, "compare", "env=hopper")
    link = store.path / layout.VIEWS / f"{code}.json"
    link.unlink()
    os.mkfifo(link)
    assert shortlinks.target(store.path, code) is None


@pytest.mark.quick
@pytest.mark.parametrize("name", ["status.json", "digests.json"])
def test_a_folder_in_place_of_a_file__is_set_aside_by_repair(store: Store, name: str):
    run = store.run("whole")
    (run.path / name).unlink()
    (run.path / name).mkdir()
    repair(run)
    assert (run.path / "damaged" / name).is_dir()
    assert verify(run) == []
