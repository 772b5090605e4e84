"""A disk that is full or may not be written, and paths that few expect."""

from multiprocessing import get_context
from pathlib import Path

import pytest
from faults import config, stopped
from same_records import assert_same_record

from tom.errors import UserError
from tom.events import Event, Tick
from tom.record import Store, checkpoint
from tom.record.integrity import repair
from tom.record.rerun.feed import stream
from tom.record.writer import RunWriter
from tom.training.resume import resume
from tom.training.run import train

pytestmark = pytest.mark.fault


def fill(folder: Path, leave: int = 0) -> Path:
    """Fill the disk of `folder` but for `leave` bytes."""
    path = folder / ".filler"
    with path.open("wb", buffering=0) as file:
        for size in (1 << 16, 1 << 12):
            try:
                while True:
                    file.write(bytes(size))
            except OSError:
                continue
        if leave:
            file.truncate(path.stat().st_size - leave)
    return path


def filling_at(step: int, folder: Path, leave: int = 0):
    def watch(event: Event) -> None:
        if event == Tick(step, "optimise"):
            fill(folder, leave)

    return (watch,)


@pytest.mark.quick
def test_disk_full_while_recording__ends_and_what_was_recorded_stays_and_resume_goes_on(
    small_disk: Path, tmp_path_factory: pytest.TempPathFactory
):
    store = Store(small_disk / "store")
    full = filling_at(130, small_disk)
    with pytest.raises(OSError, match=r"No space left|disk full"):
        train(config(steps=240), store, "a", rerun=False, watchers=full)
    run = store.run("a")
    assert len(run.metrics()) >= 3
    assert run.problems == []
    (small_disk / ".filler").unlink()
    other = Store(tmp_path_factory.mktemp("undisturbed"))
    assert_same_record(train(config(), other, "a", rerun=False), resume(store, "a", rerun=False))


@pytest.mark.quick
def test_disk_full_while_checkpointing__the_one_before_stays_and_training_goes_on_with_a_warning(
    small_disk: Path,
):
    store = Store(small_disk / "store")
    first = train(config(steps=100, checkpoint_every=100), store, "a", rerun=False)
    size = (first.path / checkpoint.FOLDER / "000000100" / "state.pt").stat().st_size
    room = filling_at(110, small_disk, leave=int(size * 0.9))
    done = resume(store, "a", steps=160, rerun=False, watchers=room)
    assert done.status.state == "finished"
    [warning] = [text for text in done.status.warnings if "no checkpoint" in text]
    assert "free some space" in warning
    held = checkpoint.load(done.path / checkpoint.FOLDER)
    assert held is not None
    assert held.env_step == 100
    assert held.unusable == {}
    (small_disk / ".filler").unlink()
    assert resume(store, "a", steps=240, rerun=False).status.env_step == 240


def test_disk_full_with_rerun__the_recording_is_cut_short_the_run_is_whole_up_to_there(
    small_disk: Path,
):
    # In a process of its own: after a full disk Rerun may block the next recording of a process.
    training = get_context("spawn").Process(target=_fill_under_rerun, args=(small_disk,))
    training.start()
    training.join()
    assert training.exitcode == 0
    run = Store(small_disk / "store").run("a")
    assert len(run.metrics()) >= 3
    assert run.problems == []


def _fill_under_rerun(disk: Path) -> None:
    watchers = filling_at(130, disk)
    with pytest.raises(OSError, match=r"No space left|disk full"):
        train(config(steps=240), Store(disk / "store"), "a", rerun=True, watchers=watchers)


@pytest.mark.quick
def test_disk_full_while_repairing__what_was_to_be_repaired_stays(small_disk: Path):
    run = train(config(steps=60), Store(small_disk / "store"), "a", rerun=False)
    rows = run.path / "metrics.jsonl"
    damaged = b"torn\n" + rows.read_bytes()
    rows.write_bytes(damaged)
    fill(small_disk)
    with pytest.raises(OSError, match="No space left"):
        repair(run)
    assert rows.read_bytes() == damaged


@pytest.mark.quick
@pytest.mark.usefixtures("modes_count")
def test_a_store_that_may_not_be_written__is_read_and_refused_in_one_line(tmp_path: Path):
    train(config(steps=60), Store(tmp_path), "a", rerun=False)
    for path in (tmp_path, *tmp_path.rglob("*")):
        path.chmod(0o555 if path.is_dir() else 0o444)
    with pytest.raises(UserError, match="cannot make run"):
        RunWriter.create(Store(tmp_path), "b", config())
    assert [run.run_id for run in Store(tmp_path).runs()] == ["a"]
    assert Store(tmp_path).run("a").problems == []
    with pytest.raises(UserError, match=r"cannot write|Permission"):
        resume(Store(tmp_path), "a", steps=400, rerun=False)


def test_a_path_with_spaces_and_unicode__trains_resumes_and_is_shown_like_any_other(
    tmp_path: Path,
):
    store = Store(tmp_path / "Läufe von Jürgen #1 %20 'x' 数据 🤖")
    stopped(store, 130)
    done = resume(store, "a", rerun=False)
    assert done.status.state == "finished"
    parts = list(stream(done))
    assert sum(map(len, parts)) > 1000
