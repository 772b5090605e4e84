"""The sha256 of every file of a finished run, so that every changed bit is detected.

Files that may change or be removed afterwards are left out: the status and the labels, recordings,
which can be made again from the files, and checkpoints, whose manifests have their own digests.
"""

import hashlib
from collections.abc import Iterator
from pathlib import Path

from tom.record import checkpoint, layout
from tom.record.files import files_in, read_json, replace_json

SCHEMA = 1
LEFT_OUT = (layout.STATUS, layout.LABELS, layout.DIGESTS)
FOLDERS_LEFT_OUT = (checkpoint.FOLDER, layout.DAMAGED)


def write(path: Path) -> None:
    """Write the digests of the run folder `path`. Raises OSError."""
    digests = {name: _digest(path / name) for name in sorted(_names(path))}
    replace_json(path / layout.DIGESTS, {"schema": SCHEMA, "sha256": digests}, sync=True)


def forget(path: Path) -> None:
    """Remove the digests of a run that is resumed, because its files will change."""
    (path / layout.DIGESTS).unlink(missing_ok=True)


def changed(path: Path) -> dict[str, str]:
    """The files that differ from what the run wrote, with the reason for each.

    Empty for a run without digests (not finished, or of an earlier version). Raises OSError or
    ValueError if the digests cannot be read.
    """
    if not (path / layout.DIGESTS).exists():
        return {}
    content = read_json(path / layout.DIGESTS)
    written = content.get("sha256")
    if content.get("schema") != SCHEMA or not isinstance(written, dict):
        raise ValueError("not a run's digests, or those of a newer version")
    there = set(_names(path))
    gone = {str(name): "is missing since the run finished" for name in {*written} - there}
    altered = {
        name: "is not what the run wrote (sha256 differs)"
        for name in sorted(there & {*written})
        if _digest(path / name) != written[name]
    }
    return gone | altered


def _names(path: Path) -> Iterator[str]:
    recordings = layout.rrd_files(path)
    for file, _ in files_in(path):
        name = file.relative_to(path)
        hidden = any(part.startswith(".") for part in name.parts)
        other = name.parts[0] in (*LEFT_OUT, *FOLDERS_LEFT_OUT) or file in recordings
        if not hidden and not other:
            yield name.as_posix()


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
