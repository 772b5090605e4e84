"""Preparation of a run folder for its next writer."""

from pathlib import Path

from tom.record import layout
from tom.record.files import replace


def drop_unfinished(path: Path) -> None:
    """Remove the temporary files of a killed writer (we hold the lock)."""
    for folder in (path, *(path / name for name in layout.FOLDERS)):
        for temporary in folder.glob(".*.tmp"):
            if not temporary.name.startswith(f".{layout.LABELS}"):  # labels are written by others
                temporary.unlink(missing_ok=True)


def make_folders(path: Path) -> None:
    """Make folders that an earlier version did not make."""
    for name in layout.FOLDERS:
        (path / name).mkdir(exist_ok=True)


def renew(path: Path) -> None:
    """Replace the growing files by copies.

    A writer on another machine may still have them open, with rows that its kernel has not sent
    yet; those rows then end in files that no longer have a name.
    """
    for name in (layout.METRICS, layout.PROFILES, layout.NOTICES):
        held = path / name
        if held.exists():
            replace(held, lambda file, held=held: file.write(held.read_bytes()), sync=True)
