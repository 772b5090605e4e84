import json
from pathlib import Path

import pytest
from recorded import Config

from tom.errors import UserError
from tom.record import Store
from tom.record.writer import RunWriter


def test_runs_come_newest_first(store: Store):
    for run_id in ("b", "c", "a"):
        RunWriter.create(store, run_id, Config).close()
    assert [run.run_id for run in store.runs()] == ["a", "c", "b"]
    assert store.problems == []


def test_what_is_no_run_is_named_and_does_not_stop_the_others(store: Store):
    RunWriter.create(store, "good", Config).close()
    RunWriter.create(store, "newer", Config).close()
    newer = json.loads((store.path / "newer" / "config.json").read_text()) | {"schema": 9}
    (store.path / "newer" / "config.json").write_text(json.dumps(newer))
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
    with pytest.raises(UserError, match=r"cannot make the store .*--store"):
        RunWriter.create(store, "run", Config)


def test_new_ids_are_free_and_say_what_they_are(store: Store):
    taken = set()
    for _ in range(3):
        run_id = store.new_run_id("hopper", "tom", 4)
        assert run_id.startswith("hopper-tom-s4-")
        RunWriter.create(store, run_id, Config).close()
        taken.add(run_id)
    assert len(taken) == 3
