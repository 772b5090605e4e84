"""A fetch that is killed while it puts the newer copy of a run in the place of the older one."""

import json
import shutil
from dataclasses import asdict
from functools import partial
from pathlib import Path

import pytest
from killed import killed_at_rename
from recorded import events

from tom.record import RunReader, Store, checkpoint, manage
from tom.record.bucket import attempts
from tom.record.bucket.attempts import (
    AHEAD,
    FETCHED,
    FETCHED_ANEW,
    Attempt,
    fetch_run,
)
from tom.record.bucket.objects import Bucket


def say(run: RunReader, state: str, env_step: int) -> None:
    content = asdict(run.status) | {"state": state, "env_step": env_step}
    (run.path / "status.json").write_text(json.dumps(content))


@pytest.fixture
def here(tmp_path: Path, record) -> Store:
    """A store that holds a labelled copy of the run from before it was finished."""
    store = Store(tmp_path / "here")
    shutil.copytree(record("run", events()[:600]).path, store.path / "run")
    say(store.run("run"), "stopped", 5)
    manage.label(store, "run", add=["mine"])
    return store


@pytest.mark.fault
@pytest.mark.quick
def test_a_fetch_killed_between_two_renames__loses_nothing(
    here: Store, store: Store, bucket_url: str
):
    fetched = shutil.copytree(store.path / "run", here.path / ".run.1.tmp")
    replace = partial(attempts._replace, here, here.run("run"), RunReader(fetched))
    assert killed_at_rename(2, replace)
    assert (here.names(), manage.trashed(here)) == ([], ["run"])
    manage.restore(here, "run")
    assert (here.run("run").status.state, here.run("run").labels.tags) == ("stopped", ("mine",))
    bucket = Bucket.open(bucket_url)
    Attempt.claim(bucket, "run").put(store.path / "run")
    assert fetch_run(bucket, "run", here) == FETCHED
    assert here.run("run").status.state == "finished"
    assert here.run("run").labels.tags == ("mine",)
    assert manage.trashed(here) == []


def test_another_run_of_that_name_is_kept_in_the_trash(here: Store, store: Store, bucket_url: str):
    """It may have been trained here, with the settings of the one in the object store."""
    path = here.path / "run" / "config.json"
    other = json.loads(path.read_text()) | {"created": "2026-01-01T00:00:00+00:00"}
    path.write_text(json.dumps(other))
    bucket = Bucket.open(bucket_url)
    Attempt.claim(bucket, "run").put(store.path / "run")
    assert fetch_run(bucket, "run", here) == FETCHED_ANEW
    assert (here.run("run").created, here.run("run").labels.tags) == (store.run("run").created, ())
    manage.trash(here, "run")
    kept = RunReader(here.path / ".trash" / "run")
    assert (kept.created, kept.labels.tags) == (other["created"], ("mine",))


@pytest.mark.parametrize("status", ["", "{", None])
@pytest.mark.parametrize(("trained_to", "done"), [(400, AHEAD), (100, FETCHED_ANEW)])
def test_a_run_whose_status_cannot_be_read_is_never_deleted(
    trained_to: int, done: str, status: str | None, here: Store, store: Store, bucket_url: str
):
    """Its checkpoints say how far it is; a status that is damaged says nothing."""
    there, bucket = store.run("run"), Bucket.open(bucket_url)
    say(there, "stopped", 300)
    checkpoint.save(there.path / checkpoint.FOLDER, 300, {"a": 1})
    Attempt.claim(bucket, "run").put(there.path)
    mine = here.run("run")
    checkpoint.save(mine.path / checkpoint.FOLDER, trained_to, {"a": 2})
    (mine.path / "status.json").unlink()
    if status is not None:
        (mine.path / "status.json").write_text(status)
    assert fetch_run(bucket, "run", here) == done
    anew = done != AHEAD
    assert here.run("run").status.state == ("stopped" if anew else "unknown")
    assert here.run("run").labels.tags == ("mine",)
    kept = here.path / ".trash" / "run" if anew else mine.path
    assert checkpoint.newest(kept / checkpoint.FOLDER) == trained_to
