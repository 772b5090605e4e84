"""Runs in an object store: put, taken over, fetched."""

import os
import shutil
from pathlib import Path
from urllib.request import Request, urlopen

import pytest
from common import change, present
from recorded import events, files

from tom.errors import UserError
from tom.record import RunReader, Store, checkpoint, manage
from tom.record import bucket as object_store
from tom.record.bucket import AHEAD, FETCHED, FETCHED_ANEW, SAME, Attempt, Bucket, fetch, fetch_run
from tom.record.lock import LostError

pytestmark = pytest.mark.slow


@pytest.fixture
def bucket(bucket_url: str) -> Bucket:
    return Bucket.open(bucket_url)


@pytest.mark.quick
def test_what_is_put_is_what_is_fetched(bucket: Bucket, record, tmp_path: Path):
    run = record("run", events()[:600])
    checkpoint.save(run.path / checkpoint.FOLDER, 100, {"a": 1})
    attempt = Attempt.claim(bucket, "run")
    assert fetch(bucket, "run", tmp_path / "there") is None, "nothing was put yet"
    attempt.put(run.path)
    checkpoint.save(run.path / checkpoint.FOLDER, 200, {"a": 2})
    checkpoint.save(run.path / checkpoint.FOLDER, 300, {"a": 3})  # the first one goes
    with (run.path / "metrics.jsonl").open("a") as rows:
        rows.write('{"env_step": 9000}\n')
    attempt.put(run.path)
    assert fetch(bucket, "run", tmp_path / "there") == attempt.name
    assert files(tmp_path / "there") == files(run.path)


def test_only_what_changed_is_put_again(bucket: Bucket, record):
    run = record("run", events()[:600])
    attempt = Attempt.claim(bucket, "run")
    attempt.put(run.path)
    kept = f"run/{attempt.name}/config.json"
    bucket.write(kept, b"as it was put first")
    attempt.put(run.path)
    assert bucket.read(kept) == b"as it was put first"


class Breaking(Bucket):
    """A store that fails after so many objects."""

    left = 10**6

    def write(self, name: str, content: bytes) -> None:
        self.left -= 1
        if self.left < 0:
            raise OSError("the store is gone")
        super().write(name, content)


def test_a_put_that_breaks_off_anywhere_leaves_a_whole_checkpoint_and_its_data(
    bucket_url: str, record, tmp_path: Path
):
    run = record("run", events()[:600])
    bucket = Breaking.open(bucket_url)
    assert isinstance(bucket, Breaking)
    attempt = Attempt.claim(bucket, "run")
    counted = {}  # rows of the metrics that a checkpoint counts on
    for step in range(1, 9):
        with (run.path / "metrics.jsonl").open("a") as rows:
            rows.write('{"env_step": 9000}\n')
        counted[step] = (run.path / "metrics.jsonl").read_bytes().count(b"\n")
        checkpoint.save(run.path / checkpoint.FOLDER, step, {"a": step})
        bucket.left = step if step > 1 else 10**6
        try:
            attempt.put(run.path)
        except OSError:
            bucket.left = 10**6
        assert fetch(bucket, "run", tmp_path / "there") == attempt.name
        held = present(checkpoint.load(tmp_path / "there" / checkpoint.FOLDER))
        put = (tmp_path / "there" / "metrics.jsonl").read_bytes()
        assert put.count(b"\n") >= counted[held.env_step]


@pytest.mark.quick
def test_a_newer_attempt_ends_the_older_and_is_the_run_once_it_is_whole(
    bucket: Bucket, record, tmp_path: Path
):
    run = record("run", events()[:600])
    old = Attempt.claim(bucket, "run")
    old.put(run.path)
    new = Attempt.claim(bucket, "run")
    with pytest.raises(LostError, match="taken over"):
        old.put(run.path)
    assert fetch(bucket, "run", tmp_path / "taken") == old.name
    new.put(tmp_path / "taken")
    bucket.remove(bucket.names(f"run/{old.name}"))
    assert fetch(bucket, "run", tmp_path / "again") == new.name
    assert files(tmp_path / "again") == files(run.path)


def test_fetch_keeps_labels_and_what_is_further_here(bucket: Bucket, record, tmp_path: Path):
    run = record("run", events()[:600])
    change(run.path / "status.json", state="stopped", env_step=5)
    attempt = Attempt.claim(bucket, "run")
    attempt.put(run.path)
    here = Store(tmp_path / "here")
    assert fetch_run(bucket, "run", here) == FETCHED
    assert fetch_run(bucket, "run", here) == SAME
    manage.label(here, "run", add=["mine"])
    change(run.path / "status.json", state="finished", env_step=600)
    attempt.put(run.path)
    assert fetch_run(bucket, "run", here) == FETCHED
    assert here.run("run").status.state == "finished"
    assert here.run("run").labels.tags == ("mine",)
    change(run.path / "status.json", state="stopped", env_step=5)
    attempt.put(run.path)
    assert fetch_run(bucket, "run", here) == AHEAD
    assert here.run("run").status.state == "finished"
    assert [path.name for path in here.path.iterdir()] == ["run"]
    with pytest.raises(UserError, match="no run 'walk'"):
        fetch_run(bucket, "walk", here)


def test_names_that_lead_out_of_the_run_are_not_fetched(bucket: Bucket, record, tmp_path: Path):
    attempt = Attempt.claim(bucket, "run")
    attempt.put(record("run", events()[:3]).path)
    name = f"store/sweeps/first/run/{attempt.name}/..%2F..%2Fplanted"
    evil = Request(f"{os.environ['AWS_ENDPOINT_URL']}/{name}", b"evil", method="PUT")
    urlopen(evil).close()
    here = Store(tmp_path / "here")
    with pytest.raises(OSError, match="leads out of"):
        fetch_run(bucket, "run", here)
    assert list(here.path.iterdir()) == []


@pytest.fixture
def here(tmp_path: Path, record) -> Store:
    """A store that holds a labelled copy of the run from before it was finished."""
    store = Store(tmp_path / "here")
    shutil.copytree(record("run", events()[:600]).path, store.path / "run")
    change(store.path / "run/status.json", state="stopped", env_step=5)
    manage.label(store, "run", add=["mine"])
    return store


def test_a_fetch_that_ends_between_two_renames_loses_nothing(
    here: Store, store: Store, bucket: Bucket, monkeypatch: pytest.MonkeyPatch
):
    fetched = shutil.copytree(store.path / "run", here.path / ".run.1.tmp")
    into_trash = manage.into_trash

    def end(*where: object) -> None:
        into_trash(*where)  # pyright: ignore[reportArgumentType]
        raise KeyboardInterrupt

    with monkeypatch.context() as ending:
        ending.setattr(manage, "into_trash", end)
        with pytest.raises(KeyboardInterrupt):
            object_store._replace(here, here.run("run"), RunReader(fetched))
    assert (here.names(), manage.trashed(here)) == ([], ["run"])
    manage.restore(here, "run")
    assert (here.run("run").status.state, here.run("run").labels.tags) == ("stopped", ("mine",))
    Attempt.claim(bucket, "run").put(store.path / "run")
    assert fetch_run(bucket, "run", here) == FETCHED
    assert here.run("run").status.state == "finished"
    assert here.run("run").labels.tags == ("mine",)
    assert manage.trashed(here) == []


def test_another_run_of_that_name_is_kept_in_the_trash(here: Store, store: Store, bucket: Bucket):
    """It may have been trained here, with the settings of the one in the object store."""
    change(here.path / "run" / "config.json", created="2026-01-01T00:00:00+00:00")
    Attempt.claim(bucket, "run").put(store.path / "run")
    assert fetch_run(bucket, "run", here) == FETCHED_ANEW
    assert (here.run("run").created, here.run("run").labels.tags) == (store.run("run").created, ())
    manage.trash(here, "run")
    kept = RunReader(here.path / ".trash" / "run")
    assert (kept.created, kept.labels.tags) == ("2026-01-01T00:00:00+00:00", ("mine",))


@pytest.mark.parametrize(("trained_to", "done"), [(400, AHEAD), (100, FETCHED_ANEW)])
def test_a_run_whose_status_cannot_be_read_is_never_deleted(
    trained_to: int, done: str, here: Store, store: Store, bucket_url: str
):
    """Its checkpoints say how far it is; a status that is damaged says nothing."""
    there, bucket = store.run("run"), Bucket.open(bucket_url)
    change(there.path / "status.json", state="stopped", env_step=300)
    checkpoint.save(there.path / checkpoint.FOLDER, 300, {"a": 1})
    Attempt.claim(bucket, "run").put(there.path)
    mine = here.run("run")
    checkpoint.save(mine.path / checkpoint.FOLDER, trained_to, {"a": 2})
    (mine.path / "status.json").write_text("{")
    assert fetch_run(bucket, "run", here) == done
    anew = done != AHEAD
    assert here.run("run").status.state == ("stopped" if anew else "unknown")
    assert here.run("run").labels.tags == ("mine",)
    kept = here.path / ".trash" / "run" if anew else mine.path
    assert checkpoint.newest(kept / checkpoint.FOLDER) == trained_to
