"""The disk space of a run, and the removal of old checkpoints."""

import shutil
from collections.abc import Sequence
from pathlib import Path

from tom.record import checkpoint, layout
from tom.record.files import files_in, size_of
from tom.record.manage import unwritten
from tom.record.reader import RunReader

PARTS = ("buffer", "checkpoint", "episodes", "fields", "policies", "recording", "weights", "rest")


def sizes(reader: RunReader) -> dict[str, int]:
    """Bytes of each of PARTS."""
    by_part: dict[str, int] = dict.fromkeys(PARTS, 0)
    recordings = set(layout.rrd_files(reader.path))
    for path, stat in files_in(reader.path):
        top = path.relative_to(reader.path).parts[0]
        part = "recording" if path in recordings else top if top in PARTS else "rest"
        by_part[part] += stat.st_size
    return by_part


def checkpoints(reader: RunReader) -> list[Path]:
    """The checkpoints of a run, newest first."""
    return checkpoint.folders(reader.path / checkpoint.FOLDER)


def prune(reader: RunReader, keep: int, *, dry_run: bool = False) -> int:
    """Delete the checkpoints of a run before its `keep` newest whole ones; returns the freed bytes.

    A dry run deletes nothing. Raises UserError while the run is being written.
    """
    if dry_run:
        return _bytes(_old(reader, keep))
    with unwritten(reader):
        old = _old(reader, keep)
        freed = _bytes(old)
        for path in old:
            shutil.rmtree(path)
    return freed


def _old(reader: RunReader, keep: int) -> list[Path]:
    """The checkpoints before the `keep` newest whole ones: a damaged one replaces none."""
    held = checkpoints(reader)
    if len(held) <= keep:
        return []
    for place, path in enumerate(held):
        if keep == 0:
            return held[place:]
        keep -= checkpoint.is_whole(path)
    return []


def _bytes(folders: Sequence[Path]) -> int:
    return sum(map(size_of, folders))
