"""Labels, trash and restore of a store's runs. Never changes a training's files."""

import os
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from tom.errors import UserError
from tom.record import labels, layout, lock
from tom.record.files import read_json, replace_json
from tom.record.labels import Labels
from tom.record.reader import RunReader
from tom.record.status import BEAT_S
from tom.record.store import Store

_TRASHED = re.compile(rf"({layout.RUN_ID.pattern})(?:~(\d+))?")  # "~" is in no run id


def rename(store: Store, run_id: str, name: str) -> Labels:
    """Give a run a display name; "" removes it. The folder and the run id stay."""
    with _changing(store, run_id) as (path, held):
        return _write(path, replace(held, name=name))


def note(store: Store, run_id: str, text: str) -> Labels:
    """Give a run a note; "" removes it."""
    with _changing(store, run_id) as (path, held):
        return _write(path, replace(held, note=text))


def tag(store: Store, run_id: str, add: Sequence[str] = (), remove: Sequence[str] = ()) -> Labels:
    """Add and remove tags of a run. Raises UserError if a tag to remove is missing."""
    with _changing(store, run_id) as (path, held):
        missing = [name for name in remove if name not in held.tags]
        if missing:
            known = ", ".join(held.tags) or "none"
            raise UserError(f"run '{run_id}' has no tag '{missing[0]}' (it has: {known})")
        kept = tuple(name for name in held.tags if name not in remove)
        return _write(path, replace(held, tags=(*kept, *add)))


def trash(store: Store, run_id: str) -> Path:
    """Move a run into `<store>/.trash/` and return its path there.

    Raises UserError if it is not a run folder of this store, or the run is being written.
    """
    reader = store.run(run_id)
    with unwritten(reader), refused(f"cannot trash run '{run_id}'"):
        return into_trash(store, run_id, reader.path)


def into_trash(store: Store, run_id: str, path: Path) -> Path:
    """Move the folder `path`, which holds the run `run_id`, into the trash; returns its new path.

    Raises OSError if it cannot be moved, UserError if the trash is a link.
    """
    folder = store.beside(layout.TRASH)
    folder.mkdir(exist_ok=True)
    place = _place(folder, run_id, _newest(folder, run_id) + 1)
    path.rename(place)
    return place


def trashed(store: Store) -> list[str]:
    """The ids of the runs in the trash, each once."""
    return sorted({run_id for run_id, _ in _entries(store.beside(layout.TRASH))})


def restore(store: Store, run_id: str) -> Path:
    """Move the run that was trashed last under that id back into the store.

    Raises the errors of `check_restorable`.
    """
    place, trashed_place = store.resolve(run_id), check_restorable(store, run_id)
    with refused(f"cannot restore run '{run_id}'"):
        trashed_place.rename(place)
    return place


def check_restorable(store: Store, run_id: str) -> Path:
    """The run that was trashed last under that id, in the trash.

    Raises UserError if there is none, or if the store has another run of that id.
    """
    place, folder = store.resolve(run_id), store.beside(layout.TRASH)
    newest = _newest(folder, run_id)
    if not newest:
        known = ", ".join(trashed(store)[:5]) or "nothing"
        raise UserError(f"no run '{run_id}' in the trash of {store.path}/ (it holds {known})")
    if os.path.lexists(place):
        raise UserError(f"{store.path}/ holds another run '{run_id}': trash that one first")
    return _place(folder, run_id, newest)


@contextmanager
def unwritten(reader: RunReader) -> Iterator[None]:
    """Hold the writer's lock: no training can open or resume the run inside the block.

    Raises UserError if one is writing it.
    """
    if reader.status.state == "running":  # alive or not: its machine's clock may be another
        lock.refuse_if_elsewhere(
            reader.path, lambda: RunReader(reader.path).status.heartbeat, 2.5 * BEAT_S
        )
    held = lock.acquire(reader.path)
    try:
        yield
    finally:
        held.close()


@contextmanager
def _changing(store: Store, run_id: str) -> Iterator[tuple[Path, Labels]]:
    """The folder of a run and its labels, locked against other changes inside the block."""
    path = store.run(run_id).path
    with refused(f"cannot label run '{run_id}'"), lock.alone_in(path):
        yield path, _held(path)


def _held(path: Path) -> Labels:
    """The labels to change. Raises UserError if they are unreadable, so as not to lose them."""
    file = path / layout.LABELS
    if not file.exists():
        return Labels()
    try:
        return labels.parse(read_json(file))
    except ValueError as error:
        raise UserError(f"{file} is damaged ({error}): mend it or move it away") from None


def _write(path: Path, changed: Labels) -> Labels:
    tidy = labels.checked(changed)
    replace_json(path / layout.LABELS, tidy.record(), sync=True)
    return tidy


def _entries(folder: Path) -> Iterator[tuple[str, int]]:
    """(run id, number among those of that id) of everything in the trash."""
    for path in folder.iterdir() if folder.is_dir() else ():
        match = _TRASHED.fullmatch(path.name)
        if match and path.is_dir():
            yield match[1], int(match[2] or 1)


def _newest(folder: Path, run_id: str) -> int:
    """The number of the run that was trashed last under `run_id`; 0 if there is none."""
    return max((number for name, number in _entries(folder) if name == run_id), default=0)


def _place(folder: Path, run_id: str, number: int) -> Path:
    return folder / (f"{run_id}~{number}" if number > 1 else run_id)


@contextmanager
def refused(what: str) -> Iterator[None]:
    """Raises UserError, which begins with `what`, for an OSError inside the block."""
    try:
        yield
    except OSError as error:
        raise UserError(f"{what}: {error.strerror or error}") from error
