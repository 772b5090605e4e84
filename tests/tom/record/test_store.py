"""The runs of a store: listed, labelled, put into the trash and brought back."""

from pathlib import Path

import pytest
from common import change
from recorded import Config, events, files

from tom.errors import UserError
from tom.record import Store, manage
from tom.record.manage import NAME_LENGTH
from tom.record.recorder import Recorder
from tom.record.status import Labels
from tom.record.writer import RunWriter


def test_what_is_no_run_is_named_and_does_not_stop_the_others(store: Store):
    RunWriter.create(store, "good", Config).close()
    RunWriter.create(store, "newer", Config).close()
    change(store.path / "newer" / "config.json", schema=9)
    (store.path / "empty").mkdir()
    (store.path / "half").mkdir()
    (store.path / "half" / "config.json").write_text('{"schema": 1, "env": "hop')
    (store.path / "foreign").mkdir()
    (store.path / "foreign" / "config.json").write_text('{"model_type": "bert"}')
    (store.path / ".trash").mkdir()
    (store.path / "weighings").mkdir()
    (store.path / "README.md").touch()
    assert [run.run_id for run in store.runs()] == ["newer", "good"]
    named = ("empty", "half", "foreign")
    assert sum(any(name in problem for problem in store.problems) for name in named) == 3
    assert len(store.problems) == 3
    assert store.run("newer").problems


@pytest.mark.parametrize("run_id", ["", "..", "a/../../x", "/etc/passwd", ".hidden", "a" * 101])
def test_ids_that_could_leave_the_store_are_refused(store: Store, run_id: str):
    with pytest.raises(UserError, match="no run id"):
        store.run(run_id)
    with pytest.raises(UserError, match="no run id"):
        RunWriter.create(store, run_id, Config)
    assert not store.path.exists()


def test_a_link_out_of_the_store_is_not_followed(store: Store, tmp_path: Path):
    RunWriter.create(Store(tmp_path / "other"), "run", Config).close()
    store.path.mkdir()
    (store.path / "run").symlink_to(tmp_path / "other" / "run")
    with pytest.raises(UserError, match="is a link"):
        store.run("run")


def test_a_store_that_is_a_file(tmp_path: Path):
    (tmp_path / "file").touch()
    store = Store(tmp_path / "file")
    with pytest.raises(UserError, match=r"cannot read the store .*--store"):
        store.runs()
    with pytest.raises(UserError, match="cannot make run"):
        RunWriter.create(store, "run", Config)


def test_new_ids_are_free_and_say_what_they_are(store: Store):
    taken = set()
    for _ in range(3):
        run_id = store.new_run_id("hopper", "tom", 4)
        assert run_id.startswith("hopper-tom-s4-")
        RunWriter.create(store, run_id, Config).close()
        taken.add(run_id)
    assert len(taken) == 3


# Labels, trash and restore


def test_labels_are_kept_and_read_back(store: Store, record):
    record("run", events()[:3])
    assert store.run("run").labels == Labels()
    manage.label(store, "run", name=" My best hopper ☺ ")
    manage.label(store, "run", add=["paper", "check", "paper"])
    manage.label(store, "run", note="first line\nsecond line")
    manage.label(store, "run", add=["late"], remove=["check"])
    read = store.run("run")
    assert read.labels == Labels("My best hopper ☺", ("paper", "late"), "first line\nsecond line")
    assert read.problems == []
    assert manage.label(store, "run", name="") == Labels("", ("paper", "late"), read.labels.note)


def test_a_running_run_can_be_labelled(store: Store):
    with Recorder(RunWriter.create(store, "run", Config)):
        assert manage.label(store, "run", note="watch this").note == "watch this"


@pytest.mark.parametrize(
    "change",
    [
        lambda s: manage.label(s, "run", name="x" * (NAME_LENGTH + 1)),
        lambda s: manage.label(s, "run", name="two\nlines"),
        lambda s: manage.label(s, "run", note="x" * 5000),
        lambda s: manage.label(s, "run", add=["  "]),
        lambda s: manage.label(s, "run", add=[f"t{i}" for i in range(21)]),
        lambda s: manage.label(s, "run", remove=["nope"]),
    ],
)
def test_bad_labels_change_nothing(store: Store, record, change):
    record("run", events()[:3])
    manage.label(store, "run", add=["kept"])
    before = files(store.path)
    with pytest.raises(UserError):
        change(store)
    assert files(store.path) == before


def test_damaged_labels_are_a_problem_and_never_written_over(store: Store, record):
    path, content = record("run", events()[:3]).path / "labels.json", "{"
    path.write_text(content)
    run = store.run("run")
    assert run.labels == Labels()
    assert "labels.json cannot be read" in run.problems[0]
    with pytest.raises(UserError, match="damaged"):
        manage.label(store, "run", name="new")
    assert path.read_text() == content


def test_trash_and_restore_move_a_run_whole(store: Store, record):
    path = record("run", events()[:600]).path
    before, writer = files(path), (path / ".writer").read_bytes()
    record("other", events()[:3])
    [place] = manage.trash(store, "run")
    assert place == store.path / ".trash" / "run"
    assert [r.run_id for r in store.runs()] == ["other"]
    assert store.problems == []
    assert manage.trashed(store) == ["run"]
    assert manage.restore(store, "run") == [path]
    assert (path / ".writer").read_bytes() != writer, "whoever still writes it must stop"
    assert files(path) == before
    assert manage.trashed(store) == []


def test_a_run_that_is_written_stays(store: Store):
    with Recorder(RunWriter.create(store, "run", Config)):
        with pytest.raises(UserError, match="being written"):
            manage.trash(store, "run")
        # Without a heartbeat the writer's lock still tells.
        change(store.path / "run/status.json", heartbeat=0.0)
        with pytest.raises(UserError, match="being written"):
            manage.trash(store, "run")
    assert [r.run_id for r in store.runs()] == ["run"]


def test_only_run_folders_of_the_store_are_trashed(store: Store, record):
    record("run", events()[:3])
    (store.path / "photos").mkdir()
    (store.path / "photos/a.jpg").write_text("mine")
    for name in ("photos", ".trash", "..", "", "photos/a.jpg"):
        with pytest.raises(UserError):
            manage.trash(store, name)
    assert (store.path / "photos/a.jpg").read_text() == "mine"
    assert not (store.path / ".trash").exists()
