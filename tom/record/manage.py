"""Runs of a store as their user manages them: labels, trash, disk space, old checkpoints.

Nothing here changes a training's files; only old checkpoints are ever deleted.
"""

import os
import re
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path

from tom.errors import UserError
from tom.record import checkpoint, labels, layout, lock
from tom.record.files import files_in, read_json, replace_json, size_of
from tom.record.labels import Labels
from tom.record.reader import RunReader
from tom.record.store import Store

PARTS = ("buffer", "checkpoint", "episodes", "fields", "policies", "recording", "weights", "rest")
"""what the disk space of a run is divided into"""

_TRASHED = re.compile(rf"({layout.RUN_ID.pattern})(?:~(\d+))?")  # "~" is in no run id


def rename(store: Store, run_id: str, name: str) -> Labels:
    """Give a run a display name; "" removes it. The folder and the run id stay."""
    return _change(store, run_id, lambda before: replace(before, name=name))


def note(store: Store, run_id: str, text: str) -> Labels:
    """Give a run a note; "" removes it."""
    return _change(store, run_id, lambda before: replace(before, note=text))


def tag(store: Store, run_id: str, add: Sequence[str] = (), remove: Sequence[str] = ()) -> Labels:
    """Add and remove tags of a run. Raises UserError if a tag to remove is missing."""

    def changed(before: Labels) -> Labels:
        for name in remove:
            if name not in before.tags:
                known = ", ".join(before.tags) or "none"
                raise UserError(f"run '{run_id}' has no tag '{name}' (it has: {known})")
        kept = (name for name in before.tags if name not in remove)
        return replace(before, tags=(*kept, *add))

    return _change(store, run_id, changed)


def trash(store: Store, run_id: str) -> Path:
    """Move a run into `<store>/.trash/` and return its path there.

    Raises UserError if it is not a run folder of this store, or the run is being written.
    """
    reader = store.run(run_id)
    with unwritten(reader), refused(f"cannot trash run '{run_id}'"):
        return into_trash(store, reader.path)


def into_trash(store: Store, path: Path) -> Path:
    """Move the run folder `path` into the trash; returns its new path.

    Raises OSError if it cannot be moved, UserError if the trash is a link.
    """
    folder = store.beside(layout.TRASH)
    folder.mkdir(exist_ok=True)
    number = max(_trashed(store).get(path.name, {}), default=0) + 1
    place = folder / (f"{path.name}~{number}" if number > 1 else path.name)
    path.rename(place)
    return place


def trashed(store: Store) -> list[str]:
    """The ids of the runs in the trash, each once."""
    return sorted(_trashed(store))


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
    place, in_trash = store.resolve(run_id), _trashed(store)
    if run_id not in in_trash:
        known = ", ".join(sorted(in_trash)[:5]) or "nothing"
        raise UserError(f"no run '{run_id}' in the trash of {store.path}/ (it holds {known})")
    if os.path.lexists(place):
        raise UserError(f"{store.path}/ holds another run '{run_id}': trash that one first")
    return max(in_trash[run_id].items())[1]


def sizes(reader: RunReader) -> dict[str, int]:
    """Bytes of each of PARTS."""
    by_part: dict[str, int] = dict.fromkeys(PARTS, 0)
    recordings = set(reader.rrd_files())
    for path, stat in files_in(reader.path):
        top = path.relative_to(reader.path).parts[0]
        part = "recording" if path in recordings else top if top in PARTS else "rest"
        by_part[part] += stat.st_size
    return by_part


def prune(reader: RunReader, keep: int, *, dry_run: bool = False) -> int:
    """Delete the checkpoints of a run before its `keep` newest whole ones; returns the freed bytes.

    A dry run deletes nothing. Raises UserError while the run is being written.
    """
    if dry_run:
        return sum(map(size_of, _before(reader, keep)))
    with unwritten(reader):
        old = _before(reader, keep)
        freed = sum(map(size_of, old))
        for path in old:
            shutil.rmtree(path)
    return freed


@contextmanager
def unwritten(reader: RunReader) -> Iterator[None]:
    """Hold the writer's lock: no training can open or resume the run inside the block.

    Raises UserError if one is writing it.
    """
    lock.refuse_if_elsewhere(reader)
    held = lock.acquire(reader.path)
    try:
        yield
    finally:
        held.close()


@contextmanager
def refused(what: str) -> Iterator[None]:
    """Raises UserError, which begins with `what`, for an OSError inside the block."""
    try:
        yield
    except OSError as error:
        raise UserError(f"{what}: {error.strerror or error}") from error


def _change(store: Store, run_id: str, changed: Callable[[Labels], Labels]) -> Labels:
    """Change the labels of a run, of several processes one after the other; returns the new ones.

    Raises UserError if the present ones are unreadable, so as not to lose them.
    """
    path = store.run(run_id).path
    file = path / layout.LABELS
    with refused(f"cannot label run '{run_id}'"), lock.alone_in(path):
        try:
            before = labels.parse(read_json(file)) if file.exists() else Labels()
        except ValueError as error:
            raise UserError(f"{file} is damaged ({error}): mend it or move it away") from None
        after = labels.checked(changed(before))
        replace_json(file, {"schema": labels.SCHEMA, **asdict(after)}, sync=True)
    return after


def _trashed(store: Store) -> dict[str, dict[int, Path]]:
    """The folders in the trash by run id and number; the last trashed one has the largest."""
    folder = store.beside(layout.TRASH)
    found: dict[str, dict[int, Path]] = {}
    for path in folder.iterdir() if folder.is_dir() else ():
        match = _TRASHED.fullmatch(path.name)
        if match and path.is_dir():
            found.setdefault(match[1], {})[int(match[2] or 1)] = path
    return found


def _before(reader: RunReader, keep: int) -> list[Path]:
    """The checkpoints before the `keep` newest whole ones: a damaged one replaces none."""
    folders = checkpoint.folders(reader.path / checkpoint.FOLDER)
    if len(folders) <= keep:
        return []
    for place, path in enumerate(folders):
        if keep == 0:
            return folders[place:]
        keep -= checkpoint.is_whole(path)
    return []
