"""Runs that were recorded for real, damaged by hand, found out and mended."""

import json
from pathlib import Path

import pandas as pd
import pytest
from recorded import Config, events

from tom.errors import UserError
from tom.record import RunReader, Store, checkpoint, manage, sizes
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
    writer.rewind(mark)
    for step in (3, 4):
        writer.metrics({"env_step": step, "x": step})
    writer.close()
    run = store.run("a")
    assert run.metrics()["x"].tolist() == [2, 3, 4]
    assert run.problems == []


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
    assert run.status.state == "stopped"
    assert "it has no checkpoint to go on from" in run.status.reason
    assert "--resume" not in run.status.reason
    assert verify(run) == []


def test_a_run_that_died_with_a_checkpoint_is_said_to_go_on_from_it(record):
    run = record()
    die(run)
    (run.path / "checkpoint" / "000000900").mkdir(parents=True)
    repair(run)
    assert "tom train --resume run goes on" in run.status.reason


@pytest.mark.parametrize("content", [None, "{", '{"state": 3}'])
def test_a_status_that_is_lost_is_made_again(record, content: str | None):
    run = record()
    path = run.path / "status.json"
    path.unlink()
    if content is not None:
        path.write_text(content)
    assert verify(run)
    repair(run)
    assert (run.status.state, run.status.env_step, run.status.total) == ("stopped", 1000, 1000)
    assert verify(run) == []


def test_a_run_that_is_written_is_not_touched(store: Store):
    with Recorder(RunWriter.create(store, "run", Config)):
        assert verify(store.run("run")) == []
        with pytest.raises(UserError, match="being written"):
            repair(store.run("run"))


def test_sizes_and_pruning_checkpoints(record):
    run = record("run", events()[:200])
    for step in (100, 200, 300):
        folder = run.path / "checkpoint" / f"{step:09d}"
        folder.mkdir(parents=True)
        (folder / "state.pt").write_bytes(bytes(1000))
    assert sizes.sizes(run)["checkpoint"] == 3000
    assert sum(sizes.sizes(run).values()) == sum(
        p.stat().st_size for p in run.path.rglob("*") if p.is_file()
    )
    assert sizes.prune(run, keep=1, dry_run=True) == 2000
    assert len(sizes.checkpoints(run)) == 3
    assert sizes.prune(run, keep=1) == 2000
    assert [p.name for p in sizes.checkpoints(run)] == ["000000300"]


def test_a_part_that_leads_elsewhere_is_not_mended(record, tmp_path: Path):
    run = record()
    outside = tmp_path / "outside"
    (run.path / "episodes").rename(outside)
    (outside / "000000001.npz").write_bytes(b"no array")
    (run.path / "episodes").symlink_to(outside)
    before = sorted(outside.iterdir())
    with pytest.raises(UserError, match="episodes of run 'run' is a link"):
        repair(run)
    assert sorted(outside.iterdir()) == before


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
    path = run.path / "metrics.jsonl"
    path.write_bytes(path.read_bytes().replace(b"-10.0", b"-99.0"))
    (problem,) = verify(run)
    assert problem == "metrics.jsonl is not what the run wrote (sha256 differs)"
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
