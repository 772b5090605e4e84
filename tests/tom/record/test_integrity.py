"""Runs that were recorded for real, damaged by hand, found out and mended."""

import json
import os
import resource
import shutil
from collections.abc import Callable
from pathlib import Path

import pandas as pd
import pytest
from killed import killed_at_rename
from recorded import Config, events, weights

from tom.config import SacRecordingConfig
from tom.errors import UserError
from tom.record import RunReader, Store, checkpoint, integrity, manage, sizes
from tom.record.array_files import read_arrays, read_table
from tom.record.export import export_small
from tom.record.integrity import repair, verify
from tom.record.recorder import Recorder
from tom.record.writer import RunWriter


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-20])


def die(run: RunReader) -> None:
    """Make the run look killed an hour ago."""
    path = run.path / "status.json"
    status = json.loads(path.read_text())
    status |= {"state": "running", "heartbeat": status["heartbeat"] - 3600}
    path.write_text(json.dumps(status))


def contents(run: Path) -> dict[Path, bytes]:
    """Every file but the one that names the last writer, which a repair is."""
    files = (path for path in run.rglob("*") if path.is_file() and path.name != ".writer")
    return {path: path.read_bytes() for path in files}


def test_a_whole_run_has_no_problems_and_nothing_to_mend(record):
    run = record()
    assert verify(run) == []
    before = contents(run.path)
    assert repair(run) == []
    assert contents(run.path) == before


@pytest.mark.parametrize(
    "name", ["episodes/000000500.npz", "buffer/000000000.npz", "weights/snapshot-000001000.parquet"]
)
def test_a_damaged_array_is_named_and_set_aside(record, name: str):
    run = record()
    truncate(run.path / name)
    damaged = (run.path / name).read_bytes()
    (problem,) = verify(run)
    assert name in problem
    (done,) = repair(run)
    assert f"damaged/{name}" in done
    assert (run.path / "damaged" / name).read_bytes() == damaged
    assert verify(run) == []


def test_damaged_lines_are_blanked_out_and_kept_aside(record):
    run = record()
    table = run.metrics()
    path = run.path / "metrics.jsonl"
    whole = path.read_bytes()
    torn = whole.replace(b"\n", b"\n{torn\n", 1) + b'{"env_step": 10'
    path.write_bytes(torn)
    assert len(verify(run)) == 2
    done = repair(run)
    assert "2 damaged lines blanked out" in done[0]
    assert path.read_bytes() == whole.replace(b"\n", b"\n     \n", 1)
    assert (run.path / "damaged/metrics.jsonl").read_bytes() == torn
    pd.testing.assert_frame_equal(run.metrics(), table)
    assert verify(run) == []


def test_a_run_that_was_mended_goes_on_where_its_checkpoint_was(store: Store):
    writer = RunWriter.create(store, "a", Config)
    for step in (1, 2):
        writer.metrics({"env_step": step, "x": step})
    mark = writer.mark()
    writer.metrics({"env_step": 3, "x": 3.5})
    writer.close()
    path = store.path / "a" / "metrics.jsonl"
    path.write_bytes(path.read_bytes().replace(b'{"env_step":1,', b'{"env_step"1;,'))
    repair(store.run("a"))
    writer = RunWriter(store.path / "a", Config)
    writer.rewind(mark, 2)
    for step in (3, 4):
        writer.metrics({"env_step": step, "x": step})
    writer.close()
    run = store.run("a")
    assert run.metrics()["x"].tolist() == [2, 3, 4]
    assert run.problems == []


def blanked(content: bytes) -> bytes:
    """The second row overwritten with NULs."""
    lines = content.split(b"\n")
    return b"\n".join([lines[0], bytes(len(lines[1])), *lines[2:]])


def zeroed(content: bytes) -> bytes:
    """NULs from within the second row to within the sixth, as of a lost sector of a disk."""
    lines = content.splitlines(keepends=True)
    first, last = len(lines[0]) + 20, sum(map(len, lines[:6])) - 20
    return content[:first] + bytes(last - first) + content[last:]


def cut_off(content: bytes) -> bytes:
    return content[:300]


def emptied(content: bytes) -> bytes:
    return b""


def changed_by_hand(content: bytes) -> bytes:
    """One number changed, a row removed and another one added."""
    first, _, third, *rest = content.replace(b"-10.0", b"-9.0").split(b"\n")
    return b"\n".join([first, third, b'{"env_step":999,"critic/q":1.0}', *rest])


@pytest.mark.parametrize(
    ("damage", "attested"),
    [(how, True) for how in (blanked, zeroed, cut_off, emptied, changed_by_hand)]
    + [(how, False) for how in (blanked, zeroed, cut_off, emptied)],
)
def test_rows_that_are_whole_in_the_table_are_put_back(
    record, damage: Callable[[bytes], bytes], attested: bool
):
    run = record()
    if not attested:  # a run that was stopped has a table and no digests
        (run.path / "digests.json").unlink()
    rows, copy = run.path / "metrics.jsonl", run.path / "metrics.parquet"
    table, true = run.metrics(), copy.read_bytes()
    damaged = damage(rows.read_bytes())
    rows.write_bytes(damaged)
    (done,) = repair(run)
    assert "rows put back from metrics.parquet" in done
    assert "damaged/metrics.jsonl" in done
    assert (run.path / "damaged/metrics.jsonl").read_bytes() == damaged
    assert copy.read_bytes() == true
    pd.testing.assert_frame_equal(run.metrics(), table)
    assert verify(run) == []
    assert repair(run) == []
    copy.unlink()  # as does a training that goes on
    held = table.dropna(axis=1, how="all")
    pd.testing.assert_frame_equal(run.metrics()[held.columns], held)


def test_rows_that_are_put_back_lie_where_checkpoints_look_for_them(record):
    run = record()
    path = run.path / "metrics.jsonl"
    whole = path.read_bytes()
    for damage in (blanked, zeroed):
        path.write_bytes(damage(whole))
        repair(run)
        mended = path.read_bytes()
        assert len(mended) == len(whole)
        assert mended.splitlines()[6:] == whole.splitlines()[6:]
        assert b"\n\n" not in mended


def test_a_training_that_goes_on_cuts_a_file_that_was_mended_shorter_to_whole_rows(store: Store):
    writer = RunWriter.create(store, "a", Config)
    for step in (1, 2, 3):
        writer.metrics({"env_step": step, "x": step})
    mark = writer.mark()
    mark["lines"][0] -= 5  # within the last row, if the file was as much longer
    writer.rewind(mark, 2)
    writer.metrics({"env_step": 3, "x": 4})
    writer.close()
    run = store.run("a")
    assert run.metrics()["x"].tolist() == [1, 2, 4]
    assert run.problems == []


def test_a_row_that_a_hand_made_longer_or_shorter_gets_its_length_back(record):
    run = record()
    path = run.path / "metrics.jsonl"
    path.write_bytes(path.read_bytes().replace(b"null", b"-1.0"))
    repair(run)  # rows without null, which a table of numbers cannot give back
    whole, table = path.read_bytes(), run.metrics()
    assert b"null" not in whole
    for changed in (b"-9", b"-9.125"):
        path.write_bytes(whole.replace(b"-10.0", changed))
        repair(run)
        assert path.read_bytes() == whole
        pd.testing.assert_frame_equal(run.metrics(), table)


def test_a_step_in_two_lines_keeps_what_only_one_of_them_says(store: Store):
    with Recorder(RunWriter.create(store, "run", Config)) as recorder:
        for name in ("a", "b", "c"):
            recorder._writer.metrics({"env_step": 5, name: 1.0, "time/wall_s": ord(name) + 0.5})
        recorder._writer.metrics({"env_step": 6, "a": 2.0})
    run = store.run("run")
    path, table = run.path / "metrics.jsonl", run.metrics()
    whole = path.read_bytes().splitlines()
    for damaged in range(4):
        lines = [bytes(len(line)) if i == damaged else line for i, line in enumerate(whole)]
        path.write_bytes(b"\n".join(lines) + b"\n")
        assert "put back" in repair(run)[0]
        mended = path.read_bytes().splitlines()
        assert [len(line) for line in mended] == [len(line) for line in whole]
        assert sum(a != b for a, b in zip(mended, whole, strict=True)) <= 1
        os.utime(path)  # so that the rows are read and not the table
        pd.testing.assert_frame_equal(run.metrics(), table, check_like=True)


def test_a_table_that_is_made_again_is_kept_aside(record):
    run = record()
    (run.path / "digests.json").unlink()  # without them, nothing tells which of the two is true
    rows, copy = run.path / "metrics.jsonl", run.path / "metrics.parquet"
    true = copy.read_bytes()
    rows.write_bytes(rows.read_bytes().replace(b"-10.0", b"-99.0"))
    (done,) = repair(run)
    assert "damaged/metrics.parquet" in done
    assert (run.path / "damaged/metrics.parquet").read_bytes() == true
    assert run.metrics()["model/holdout_nll"][0] == -99.0


def test_a_whole_run_whose_files_were_copied_in_any_order_has_nothing_to_mend(record):
    run = record()
    os.utime(run.path / "metrics.jsonl")
    before = contents(run.path)
    assert repair(run) == []
    assert contents(run.path) == before


def test_damage_twice_keeps_both(record):
    run = record()
    for _ in range(2):
        with (run.path / "notices.jsonl").open("ab") as file:
            file.write(b"{half")
        repair(run)
    names = {p.name for p in (run.path / "damaged").iterdir()}
    assert names == {"notices.jsonl", "notices.jsonl~2"}


def test_a_run_that_died_is_said_to_have_stopped(record):
    run = record()
    die(run)
    (run.path / "metrics.parquet").unlink()
    (run.path / "weights/.snapshot-000000001.parquet.123.tmp").write_bytes(b"half")
    assert any("says it is running" in problem for problem in verify(run))
    done = repair(run)
    assert any("running became stopped at step 1000" in line for line in done)
    assert (run.path / "metrics.parquet").exists()
    status = RunReader(run.path).status
    assert status.state == "stopped"
    assert "it has no checkpoint to go on from" in status.reason
    assert "--resume" not in status.reason
    assert verify(run) == []


def test_a_run_that_died_with_a_checkpoint_is_said_to_go_on_from_it(record):
    run = record()
    die(run)
    (run.path / "checkpoint" / "000000900").mkdir(parents=True)
    repair(run)
    assert "tom train --resume run goes on" in RunReader(run.path).status.reason


@pytest.mark.parametrize("content", [None, "{"])
def test_a_status_that_is_lost_is_made_again(record, content: str | None):
    run = record()
    path = run.path / "status.json"
    path.unlink()
    if content is not None:
        path.write_text(content)
    assert verify(run)
    repair(run)
    assert progress(run) == ("finished", 1000, 1000, -5000.0, 2500.0, "")
    assert verify(run) == []


def progress(run: RunReader) -> tuple[str, int, int, float | None, float | None, str]:
    now = RunReader(run.path).status
    return now.state, now.env_step, now.total, now.last_return, now.best_return, now.reason


def lose_status(run: RunReader) -> None:
    (run.path / "status.json").write_text('{"state": "finis')


def test_a_small_copy_whose_status_is_lost_is_that_of_a_finished_run(record, tmp_path: Path):
    copy = RunReader(export_small(record(), tmp_path / "copies"))
    before = progress(copy)
    lose_status(copy)
    repair(copy)
    assert progress(copy) == before
    assert RunReader(copy.path).shown == "finished (a small copy)"
    assert verify(copy) == []


def test_a_recording_whose_status_is_lost_has_all_its_steps(store: Store):
    config = SacRecordingConfig(env="hopper", steps=500)  # as many random ones come before them
    with Recorder(RunWriter.create(store, "run", config)) as recorder:
        for event in events():
            recorder.consume(event)
    run = store.run("run")
    before = progress(run)
    lose_status(run)
    repair(run)
    assert progress(run) == before
    assert before[::2][:2] == ("finished", 1000)


def test_a_status_that_is_lost_with_rows_is_made_of_the_rows_that_are_put_back(record):
    run = record()
    before = progress(run)
    lose_status(run)
    path = run.path / "metrics.jsonl"
    path.write_bytes(path.read_bytes()[:300])
    repair(run)
    assert progress(run) == before


def test_a_run_that_had_not_finished_has_stopped_when_its_status_is_lost(
    store: Store, tmp_path: Path
):
    for name, given in (("at-the-end", events()[:-1]), ("half", events()[:700])):
        with Recorder(RunWriter.create(store, name, Config)) as recorder:
            for event in given:
                recorder.consume(event)
            recorder.finish("stopped")
    copy = RunReader(export_small(store.run("half"), tmp_path / "copies"))
    for run in (store.run("at-the-end"), store.run("half"), copy):
        before = progress(run)
        lose_status(run)
        repair(run)
        after = progress(run)
        assert after[0] == "stopped"
        assert "without a word" in after[-1]
        assert after[2:5] == before[2:5]


def test_a_run_that_is_written_is_not_touched(store: Store):
    with Recorder(RunWriter.create(store, "run", Config)):
        assert verify(store.run("run")) == []
        with pytest.raises(UserError, match="being written"):
            repair(store.run("run"))


@pytest.mark.fault
@pytest.mark.quick
@pytest.mark.parametrize("number", [1, 2, 3])
def test_a_repair_killed_at_a_rename__leaves_every_row_and_the_next_one_mends_it(
    record, number: int
):
    run = record()
    rows = run.path / "notices.jsonl"
    rows.write_bytes(b"damaged\n" + rows.read_bytes())
    held = run.notices()
    killed_at_rename(number, lambda: repair(run))
    assert run.notices() == held
    repair(run)
    assert run.notices() == held
    assert verify(run) == []


@pytest.mark.fault
@pytest.mark.quick
def test_a_disk_that_is_full_during_a_repair__is_named_and_the_rows_stay(record):
    run = record()
    rows = run.path / "metrics.jsonl"
    rows.write_bytes(b"damaged\n" + rows.read_bytes())
    held = rows.read_bytes()
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (500, before[1]))
    try:
        with pytest.raises(UserError, match="cannot repair run 'run'"):
            repair(run)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert rows.read_bytes() == held
    assert [path for path in (run.path / "damaged").rglob("*") if path.is_file()] == []


def test_sizes_and_pruning_checkpoints(record, tmp_path: Path):
    run = record("run", events()[:200])
    for step in (100, 200, 300):
        one = checkpoint.save(tmp_path / str(step), step, {"step": step})
        shutil.copytree(one, run.path / checkpoint.FOLDER / one.name)
    each = [sum(p.stat().st_size for p in path.iterdir()) for path in sizes.checkpoints(run)]
    assert sizes.sizes(run)["checkpoint"] == sum(each)
    assert sum(sizes.sizes(run).values()) == sum(
        p.stat().st_size for p in run.path.rglob("*") if p.is_file()
    )
    assert sizes.prune(run, keep=1, dry_run=True) == sum(each[1:])
    assert len(sizes.checkpoints(run)) == 3
    truncate(sizes.checkpoints(run)[0] / checkpoint.STATE)
    assert sizes.prune(run, keep=1) == each[2]
    assert [p.name for p in sizes.checkpoints(run)] == ["000000300", "000000200"]
    truncate(sizes.checkpoints(run)[1] / checkpoint.STATE)
    assert sizes.prune(run, keep=1) == 0, "none is whole: a part of one may be saved by hand"


def test_the_model_of_a_small_copy_is_read_too(record):
    run = record()
    state = checkpoint.save(run.path / "model", 5, {}) / checkpoint.STATE
    assert verify(run) == []
    state.write_bytes(state.read_bytes()[:-1])
    assert verify(run) == ["model is damaged: ghosts and model errors are missing"]


def flip(path: Path, at: int) -> None:
    content = bytearray(path.read_bytes())
    content[at] ^= 1
    path.write_bytes(content)


@pytest.mark.fault
@pytest.mark.quick
@pytest.mark.parametrize(
    "name",
    ["weights/snapshot-000001000.parquet", "metrics.jsonl", "buffer/000000000.npz", "config.json"],
)
def test_a_bit_flipped_in_any_file_of_a_finished_run__is_found_by_its_digest(record, name: str):
    run = record()
    size = (run.path / name).stat().st_size
    for at in range(0, size, max(size // 40, 1)):
        flip(run.path / name, at)
        assert any(name in problem for problem in verify(run)), at
        flip(run.path / name, at)
    assert verify(run) == []


@pytest.mark.fault
@pytest.mark.quick
@pytest.mark.parametrize("name", ["weights/snapshot-000001000.parquet", "fields/map-000000500.npz"])
def test_weights_that_read_well_and_are_not_those_of_the_run__are_named_and_set_aside(
    record, name: str
):
    run = record()
    other = run.path / (
        "weights/snapshot-000000400.parquet" if "weights" in name else "fields/map-000001000.npz"
    )
    content = other.read_bytes()
    (run.path / name).write_bytes(content)
    (problem,) = verify(run)
    assert problem == f"{name} is not what the run wrote (sha256 differs)"
    (done,) = repair(run)
    assert f"damaged/{name}" in done
    assert (run.path / "damaged" / name).read_bytes() == content
    assert verify(run) == []


@pytest.mark.fault
@pytest.mark.quick
def test_rows_that_were_changed_by_hand__are_named_and_kept(record):
    run = record()
    path = run.path / "notices.jsonl"
    path.write_bytes(path.read_bytes().replace(b"zero", b"well"))
    (problem,) = verify(run)
    assert problem == "notices.jsonl is not what the run wrote (sha256 differs)"
    assert any("nothing tells what it was" in line for line in repair(run))
    assert verify(run) == []


def test_a_file_that_is_gone_and_digests_that_are_damaged_are_named(record):
    run = record()
    (run.path / "episodes" / "000000500.npz").unlink()
    assert verify(run) == ["episodes/000000500.npz is missing since the run finished"]
    truncate(run.path / "digests.json")
    (problem,) = verify(run)
    assert problem.startswith("digests.json cannot be read")
    assert repair(run) == ["digests.json: made again"]
    assert verify(run) == []


def test_what_people_change_afterwards_and_old_runs_without_digests_are_no_problems(
    record, store: Store
):
    run = record()
    manage.tag(store, "run", ["good"])
    checkpoint.save(run.path / checkpoint.FOLDER, 1000, {"a": 1})
    sizes.prune(run, 0)
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
    flip(copy.path / "metrics.jsonl", 20)
    assert "metrics.jsonl" in verify(copy)[0]
    with (
        pytest.raises(RuntimeError, match="ends"),
        Recorder(RunWriter.create(Store(tmp_path), "b", Config)),
    ):
        raise RuntimeError("it ends early")
    assert not (tmp_path / "b" / "digests.json").exists()


def test_a_snapshot_that_the_training_deletes_meanwhile_is_no_damage(
    store: Store, monkeypatch: pytest.MonkeyPatch
):
    """It was there when the files of the run were listed."""
    with Recorder(RunWriter.create(store, "run", Config)) as recorder:
        for step in (100, 200):
            recorder.consume(weights(step))
        replaced = store.path / "run" / "weights/snapshot-000000200.parquet"

        def read(path: Path) -> object:
            if path == replaced:
                recorder.consume(weights(300))
            return read_table(path)

        monkeypatch.setattr(integrity, "read_table", read)
        assert replaced.exists()
        assert verify(store.run("run")) == []
        assert not replaced.exists()


def test_a_file_that_no_training_deletes_is_missed_if_it_vanishes(
    record, monkeypatch: pytest.MonkeyPatch
):
    run = record(given=events()[:600])
    gone = run.path / "episodes/000000500.npz"
    (run.path / "digests.json").unlink()

    def read(path: Path) -> object:
        gone.unlink(missing_ok=True)
        return read_arrays(path)

    monkeypatch.setattr(integrity, "read_arrays", read)
    (problem,) = verify(run)
    assert problem.startswith("episodes/000000500.npz cannot be read")
