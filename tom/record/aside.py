"""Damaged parts of a run are set aside in its `damaged/` folder, never deleted."""

import os
import shutil
from pathlib import Path

from tom.record import layout


def set_aside(run: Path, path: Path) -> Path:
    """Move a file or folder of the run folder `run` into its `damaged/`; returns the new place."""
    place = _place(run, path)
    path.rename(place)
    return place


def copy_aside(run: Path, path: Path) -> Path:
    """`set_aside` for a file that is replaced next, so that no kill finds the run without it."""
    place = _place(run, path)
    try:
        shutil.copy2(path, place)
    except BaseException:
        place.unlink(missing_ok=True)
        raise
    return place


def _place(run: Path, path: Path) -> Path:
    """A free place for it."""
    place = run / layout.DAMAGED / path.relative_to(run)
    place.parent.mkdir(parents=True, exist_ok=True)
    number = 1
    while os.path.lexists(place):
        number += 1
        place = place.with_name(f"{path.name}~{number}")
    return place
