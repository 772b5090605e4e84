"""Copies runs out of an object store into a run store, where everything else can read them."""

import os
import shutil
from pathlib import Path

from tom.errors import UserError
from tom.record import layout, lock, manage
from tom.record.bucket import attempts
from tom.record.bucket.objects import Bucket
from tom.record.reader import RunReader
from tom.record.store import Store

FETCHED, SAME, AHEAD, BUSY = "fetched", "is up to date", "is further here", "is being written here"


def run_ids(bucket: Bucket) -> list[str]:
    """The runs in the object store. Raises OSError where it does not answer."""
    return [name for name in bucket.folders() if layout.RUN_ID.fullmatch(name)]


def fetch_run(bucket: Bucket, run_id: str, store: Store) -> str:
    """Bring the store's copy of a run up to date; what was done.

    Labels given here stay, and so does a run that is further here. Raises UserError where there is
    no such run, OSError where the object store does not answer.
    """
    place = store.resolve(run_id)
    unfinished = store.path / f".{run_id}.{os.getpid()}.tmp"
    with lock.alone_in(store.path):
        _mend(store, place)
    try:
        if attempts.fetch(bucket, run_id, unfinished) is None:
            raise UserError(f"no run '{run_id}' in {bucket.url}")
        with lock.alone_in(store.path):
            _mend(store, place)
            if place.exists():
                return _replace(RunReader(place), RunReader(unfinished))
            unfinished.rename(place)
            return FETCHED
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)


def _replace(held: RunReader, fetched: RunReader) -> str:
    """Put what was fetched in the place of what the store held, where that is behind."""
    if lock.held(held.path):
        return BUSY
    if held.status == fetched.status:
        return SAME
    if held.status.state == "finished" or held.status.env_step > fetched.status.env_step:
        return AHEAD
    labels = held.path / layout.LABELS
    with manage.unwritten(held):
        if labels.is_file() and not labels.is_symlink():
            shutil.copy2(labels, fetched.path / layout.LABELS)
        _swap(held.path, fetched.path)
    return FETCHED


def _swap(place: Path, unfinished: Path) -> None:
    """Put the fetched copy in the run's place; the older copy is left as `unfinished`.

    `fetch_run` deletes whatever is left as `unfinished`, so the older copy goes with it.
    """
    older = _older(place)
    place.rename(older)
    unfinished.rename(place)
    older.rename(unfinished)


def _older(place: Path) -> Path:
    """Where a run lies for the instant in which a newer copy takes its place."""
    return place.with_name(f".{place.name}.old")


def _mend(store: Store, place: Path) -> None:
    """Bring back the run that a fetch had moved when it was killed.

    Where another one has its place by now, which may be no copy of it, it goes to the trash.
    """
    older = _older(place)
    if not older.is_dir():
        return
    if place.exists():
        manage.into_trash(store, place.name, older)
    else:
        older.rename(place)
