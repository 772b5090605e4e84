"""Runs that were recorded for real, damaged by hand, found out and repaired."""

import os
import shutil
from pathlib import Path

import pytest
from common import change, cut, flip
from recorded import Config, events, files

from tom.errors import UserError
from tom.record import RunReader, Store, checkpoint, manage
from tom.record.export import export_small
from tom.record.integrity import repair, verify
from tom.record.recorder import Recorder
from tom.record.writer import RunWriter


@pytest.mark.parametrize("copied", [False, True])
def test_a_whole_run_has_no_problems_and_nothing_to_repair(record, copied: bool):
    run = record()
    if copied:  # its files in any order
        os.utime(run.path / "metrics.jsonl")
    assert verify(run) == []
    before = files(run.path)
    assert repair(run) == []
    assert files(run.path) == before


def test_a_damaged_array_is_named_and_set_aside(record):
    run, name = record(), "episodes/000000500.npz"
    cut(run.path / name)
    damaged = (run.path / name).read_bytes()
    (problem,) = verify(run)
    assert name in problem
    assert f"damaged/{name}" in repair(run)[0]
    assert (run.path / "damaged" / name).read_bytes() == damaged
    assert verify(run) == []


def test_damaged_lines_become_blank_where_they_are_and_are_kept_aside(record):
    run = record()
    before, path = run.notices(), run.path / "notices.jsonl"
    whole = path.read_bytes()
    torn = whole.replace(b"\n", b"\n{torn\n", 1) + b'{"env_step": 10'
    path.write_bytes(torn)
    assert len(verify(run)) == 2
    repair(run)
    assert path.read_bytes() == whole.replace(b"\n", b"\n     \n", 1)
    assert (run.path / "damaged/notices.jsonl").read_bytes() == torn
    assert run.notices() == before
    assert verify(run) == []
    path.write_bytes(torn)
    repair(run)
    names = {p.name for p in (run.path / "damaged").iterdir()}
    assert names == {"notices.jsonl", "notices.jsonl-2"}


def test_a_row_that_was_damaged_is_still_read_from_the_table_after_a_repair(record):
    run = record()
    before, path = run.metrics(), run.path / "metrics.jsonl"
    at = path.stat().st_mtime_ns
    flip(path, 0)
    os.utime(path, ns=(at, at))  # no write, but a bit on the disk
    assert len(verify(run)) == 1
    repair(run)
    assert run.metrics().equals(before)
    assert verify(run) == []


def test_a_run_that_died_becomes_stopped(record):
    run = record()
    beat = RunReader(run.path).status.heartbeat - 3600
    change(run.path / "status.json", state="running", heartbeat=beat)
    assert any("heartbeat" in problem for problem in verify(run))
    repair(run)
    now = RunReader(run.path)
    assert (now.status.state, now.status.env_step) == ("stopped", 1000)
    assert verify(now) == []


def test_live_weights_are_repaired_with_their_run(record):
    run, live = record(), record("live")
    (run.path / "live").mkdir()
    live = RunReader(live.path.rename(run.path / "live/tom"))
    beat = live.status.heartbeat - 3600
    change(live.path / "status.json", state="running", heartbeat=beat)
    with (live.path / "notices.jsonl").open("ab") as file:
        file.write(b"{torn\n")
    assert len(verify(run)) == 2
    repair(run)
    assert RunReader(live.path).status.state == "stopped"
    assert verify(run) == []


def test_a_run_that_is_written_is_not_touched(store: Store):
    with Recorder(RunWriter.create(store, "run", Config)):
        assert verify(store.run("run")) == []
        with pytest.raises(UserError, match="being written"):
            repair(store.run("run"))


def test_pruning_checkpoints(record, tmp_path: Path):
    run = record("run", events()[:200])
    for step in (100, 200, 300):
        one = checkpoint.save(tmp_path / str(step), step, {"step": step})
        shutil.copytree(one, run.path / checkpoint.FOLDER / one.name)

    def folders() -> list[Path]:
        return checkpoint.folders(run.path / checkpoint.FOLDER)

    each = [sum(p.stat().st_size for p in path.iterdir()) for path in folders()]
    assert manage.prune(run, keep=1, dry_run=True) == sum(each[1:])
    assert len(folders()) == 3
    cut(folders()[0] / checkpoint.STATE)
    assert manage.prune(run, keep=1) == each[2]
    assert [p.name for p in folders()] == ["000000300", "000000200"]
    cut(folders()[1] / checkpoint.STATE)
    assert manage.prune(run, keep=1) == 0, "none is whole: a part of one may be saved by hand"


def test_the_model_of_a_small_copy_is_read_too(record):
    run = record()
    state = checkpoint.save(run.path / "model", 5, {}) / checkpoint.STATE
    assert verify(run) == []
    state.write_bytes(state.read_bytes()[:-1])
    (problem,) = verify(run)
    assert problem.startswith("model ")


def test_a_changed_bit_of_a_finished_run_is_found_by_its_digest(record):
    run = record()
    for name in ("weights/snapshot-000001000.parquet", "metrics.jsonl", "config.json"):
        for at in (0, (run.path / name).stat().st_size - 1):
            flip(run.path / name, at)
            assert any(name in problem for problem in verify(run)), at
            flip(run.path / name, at)
    assert verify(run) == []


def test_a_file_that_is_gone_is_named(record):
    run = record()
    (run.path / "episodes" / "000000500.npz").unlink()
    (problem,) = verify(run)
    assert problem.startswith("episodes/000000500.npz")


def test_what_people_change_afterwards_and_old_runs_without_digests_are_no_problems(
    record, store: Store
):
    run = record()
    manage.label(store, "run", add=["good"])
    checkpoint.save(run.path / checkpoint.FOLDER, 1000, {"a": 1})
    manage.prune(run, 0)
    assert verify(run) == []
    (run.path / "digests.json").unlink()
    assert verify(run) == []
    assert repair(run) == []


def test_a_run_that_has_not_finished_has_no_digests_and_a_small_copy_has_its_own(
    record, tmp_path: Path
):
    run = record(given=events()[:300])
    assert (run.path / "digests.json").exists()
    copy = RunReader(export_small(run, tmp_path / "copies"))
    assert verify(copy) == []
    flip(copy.path / "metrics.jsonl.gz", 40)
    assert "metrics.jsonl" in verify(copy)[0]
    with (
        pytest.raises(RuntimeError, match="ends"),
        Recorder(RunWriter.create(Store(tmp_path), "b", Config)),
    ):
        raise RuntimeError("it ends early")
    assert not (tmp_path / "b" / "digests.json").exists()
