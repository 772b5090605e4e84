"""Labels, trash and restore of runs that were recorded for real."""

import json
from pathlib import Path

import pytest
from recorded import Config, events

from tom.errors import UserError
from tom.record import Store, manage
from tom.record.manage import NAME_LENGTH
from tom.record.recorder import Recorder
from tom.record.status import Labels
from tom.record.writer import RunWriter


def files(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


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
    before = files(record("run", events()[:600]).path)
    record("other", events()[:3])
    [place] = manage.trash(store, "run")
    assert place == store.path / ".trash" / "run"
    assert [r.run_id for r in store.runs()] == ["other"]
    assert store.problems == []
    assert manage.trashed(store) == ["run"]
    restored = files(*manage.restore(store, "run"))
    assert restored.pop(".writer") != before.pop(".writer"), "whoever still writes it must stop"
    assert restored == before
    assert manage.trashed(store) == []


def test_a_run_that_is_written_stays(store: Store):
    with Recorder(RunWriter.create(store, "run", Config)):
        with pytest.raises(UserError, match="being written"):
            manage.trash(store, "run")
        # Without a heartbeat the writer's lock still tells.
        status = json.loads((store.path / "run/status.json").read_text())
        (store.path / "run/status.json").write_text(json.dumps(status | {"heartbeat": 0.0}))
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
