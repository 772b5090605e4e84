"""Copy runs from an object store into a run store."""

import shutil
from pathlib import Path

from tom.errors import UserError
from tom.record import checkpoint, layout, lock, manage
from tom.record.bucket import attempts
from tom.record.bucket.objects import Bucket
from tom.record.files import beside
from tom.record.reader import RunReader
from tom.record.store import Store

FETCHED, SAME, AHEAD, BUSY = "fetched", "is up to date", "is further here", "is being written here"
FETCHED_ANEW = "fetched; another run of that name that was here is in the trash"
FETCHED_UNKNOWN = "fetched; what was here, whose status cannot be read, is in the trash"


def run_ids(bucket: Bucket) -> list[str]:
    """The ids of the runs in the object store. Raises OSError if it does not answer."""
    return [name for name in bucket.folders() if layout.RUN_ID.fullmatch(name)]


def fetch_run(bucket: Bucket, run_id: str, store: Store) -> str:
    """Bring the store's copy of a run up to date; returns what was done.

    Local labels are kept, and so is a local run that is further. Raises UserError if there is no
    such run, OSError if the object store does not answer.
    """
    place = store.resolve(run_id)
    unfinished = beside(place)
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
    """Replace the store's run by the fetched one if that is further.

    An older copy of it is deleted. Another run of that name goes to the trash, and so does a run
    of which nobody can tell how far it got.
    """
    if lock.held(held.path):
        return BUSY
    if held.status == fetched.status:
        return SAME
    if held.status.state == "finished" or _reached(held) > _reached(fetched):
        return AHEAD
    labels = held.path / layout.LABELS
    with manage.unwritten(held):
        if held.config.get("created") != fetched.config.get("created"):
            _trash(held, fetched)
            return FETCHED_ANEW
        if labels.is_file():
            shutil.copy2(labels, fetched.path / layout.LABELS)
        if held.status.state == "unknown":
            _trash(held, fetched)
            return FETCHED_UNKNOWN
        _swap(held.path, fetched.path)
    return FETCHED


def _reached(run: RunReader) -> int:
    """How far the run got; its status may be damaged, and then its checkpoints tell."""
    return max(run.status.env_step, checkpoint.newest(run.path / checkpoint.FOLDER) or 0)


def _trash(held: RunReader, fetched: RunReader) -> None:
    """Put the fetched run in the place of the other, which goes to the trash."""
    manage.into_trash(Store(held.path.parent), held.run_id, held.path)
    fetched.path.rename(held.path)


def _swap(place: Path, unfinished: Path) -> None:
    """Put the fetched copy in the run's place; the older copy is left as `unfinished`.

    `fetch_run` deletes whatever is left as `unfinished`, so the older copy goes with it.
    """
    older = _older(place)
    place.rename(older)
    unfinished.rename(place)
    older.rename(unfinished)


def _older(place: Path) -> Path:
    """The path to which a run is moved while a newer copy takes its place."""
    return place.with_name(f".{place.name}.old")


def _mend(store: Store, place: Path) -> None:
    """Restore a run that a killed fetch had moved away.

    If another run has its place by now, which may not be a copy of it, it goes to the trash.
    """
    older = _older(place)
    if not older.is_dir():
        return
    if place.exists():
        manage.into_trash(store, place.name, older)
    else:
        older.rename(place)
