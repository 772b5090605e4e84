"""Runs of a store as their user manages them: labels, trash, old checkpoints.

Nothing here changes a training's files; only old checkpoints are ever deleted. All may raise
OSError.
"""

import os
import re
import shutil
from collections.abc import Sequence
from contextlib import ExitStack, closing, nullcontext
from dataclasses import asdict
from pathlib import Path

from tom.errors import UserError
from tom.record import checkpoint, layout, lock
from tom.record.files import read_json, replace_json, size_of
from tom.record.reader import RunReader
from tom.record.status import Labels, labels_of
from tom.record.store import Store

NAME_LENGTH, TAG_LENGTH, NOTE_LENGTH, MOST_TAGS = 100, 30, 4000, 20
"""most characters of labels, and the most tags; every run id may be a name"""

_TRASHED = re.compile(rf"({layout.RUN_ID.pattern})(?:~(\d+))?")  # "~" is in no run id


def label(
    store: Store,
    run_id: str,
    *,
    name: str | None = None,
    note: str | None = None,
    add: Sequence[str] = (),
    remove: Sequence[str] = (),
) -> Labels:
    """Give a run a display name and a note ("" takes them away), add and remove tags.

    The folder and the run id stay. Of several processes one comes after the other. Raises UserError
    for a bad label, a tag to remove that is missing, or if the present labels are unreadable, so as
    not to lose them.
    """
    path = store.run(run_id).path
    file = path / layout.LABELS
    with lock.exclusive_lock(path):
        try:
            before = labels_of(read_json(file)) if file.exists() else Labels()
        except ValueError as error:
            raise UserError(f"{file} is damaged ({error}): fix it or move it away") from None
        for tag in remove:
            if tag not in before.tags:
                known = ", ".join(before.tags) or "none"
                raise UserError(f"run '{run_id}' has no tag '{tag}' (it has: {known})")
        every = (*(tag for tag in before.tags if tag not in remove), *add)
        tags = tuple(dict.fromkeys(_plain("tag", tag, TAG_LENGTH) for tag in every))
        if "" in tags or len(tags) > MOST_TAGS:
            raise UserError(f"a tag cannot be empty, and a run has at most {MOST_TAGS}")
        named = _plain("name", before.name if name is None else name, NAME_LENGTH)
        noted = _plain("note", before.note if note is None else note, NOTE_LENGTH)
        after = Labels(named, tags, noted)
        replace_json(file, {"schema": layout.SCHEMA, **asdict(after)}, sync=True)
    return after


def _plain(kind: str, text: str, length: int) -> str:
    """The text without white space around it. Raises UserError if it is too long or not plain."""
    if not (text.replace("\n", "") if kind == "note" else text).isprintable():
        lines = "" if kind == "note" else " of one line"
        raise UserError(f"a {kind} is plain text{lines}, not {text!r:.60}")
    if len(text.strip()) > length:
        raise UserError(f"a {kind} of {len(text)} characters is too long: {length} at most")
    return text.strip()


def trash(store: Store, *run_ids: str) -> list[Path]:
    """Move runs into `<store>/.trash/`, all or none; returns their paths there.

    Raises UserError if one is not a run folder of this store, or is being written.
    """
    readers = [store.run(run_id) for run_id in dict.fromkeys(run_ids)]
    with ExitStack() as locks:
        for reader in readers:
            locks.enter_context(closing(lock.acquire(reader.path)))
        return [into_trash(store, reader.path) for reader in readers]


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


def restore(store: Store, *run_ids: str) -> list[Path]:
    """Move the runs that were trashed last under these ids back into the store, all or none.

    Raises UserError if there is none, or if the store has another run of that id.
    """
    moves, in_trash = [], _trashed(store)
    for run_id in dict.fromkeys(run_ids):
        place = store.resolve(run_id)
        if run_id not in in_trash:
            known = ", ".join(sorted(in_trash)[:5]) or "nothing"
            raise UserError(f"no run '{run_id}' in the trash of {store.path}/ (it holds {known})")
        if os.path.lexists(place):
            raise UserError(f"{store.path}/ holds another run '{run_id}': trash that one first")
        moves.append((max(in_trash[run_id].items())[1], place))
    for trashed_place, place in moves:
        trashed_place.rename(place)
    return [place for _, place in moves]


def prune(reader: RunReader, keep: int, *, dry_run: bool = False) -> int:
    """Delete the checkpoints of a run before its `keep` newest whole ones; returns the freed bytes.

    A damaged one replaces none. A dry run deletes nothing. Raises UserError while the run is being
    written.
    """
    with nullcontext() if dry_run else closing(lock.acquire(reader.path)):
        old = checkpoint.folders(reader.path / checkpoint.FOLDER)
        while old and keep:
            keep -= checkpoint.is_whole(old.pop(0))
        freed = sum(map(size_of, old))
        for path in () if dry_run else old:
            shutil.rmtree(path)
    return freed


def _trashed(store: Store) -> dict[str, dict[int, Path]]:
    """The folders in the trash by run id and number; the last trashed one has the largest."""
    folder = store.beside(layout.TRASH)
    found: dict[str, dict[int, Path]] = {}
    for path in folder.iterdir() if folder.is_dir() else ():
        match = _TRASHED.fullmatch(path.name)
        if match and path.is_dir():
            found.setdefault(match[1], {})[int(match[2] or 1)] = path
    return found
