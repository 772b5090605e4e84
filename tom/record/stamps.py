"""Stamps: values that change whenever the files of a part of a run change. No file is read.

A cache stores data read from a run together with its stamp (`app/data/cache.py`).
"""

import os
from pathlib import Path

from tom.record import checkpoint, layout

Stamp = tuple[tuple[int, int], ...]
"""(mtime_ns, size) of each file; (0, 0) for a missing one"""


def stamp(*paths: Path) -> Stamp:
    """The stamp of these files."""
    return tuple(_of(path) for path in paths)


def about(run: Path) -> Stamp:
    """The stamp of configuration, status and labels."""
    return _inside(run, layout.CONFIG, layout.STATUS, layout.LABELS)


def metrics(run: Path) -> Stamp:
    return _inside(run, layout.METRICS, layout.METRICS_TABLE)


def profiles(run: Path) -> Stamp:
    return _inside(run, layout.PROFILES)


def notices(run: Path) -> Stamp:
    return _inside(run, layout.NOTICES)


def snapshot(run: Path, step: int) -> Stamp:
    return stamp(run / layout.snapshot(step))


def fields(run: Path, step: int, *names: str) -> Stamp:
    return stamp(*(run / layout.field(name, step) for name in names))


def episodes(run: Path, step: int) -> Stamp:
    return stamp(run / layout.episodes(step))


def buffer(run: Path) -> Stamp:
    """The stamp of the last segment of the replay buffer; empty if there is none."""
    last = layout.numbers(run / layout.BUFFER, ".npz")[-1:]
    return stamp(*(run / layout.segment(first) for first in last))


def policies(run: Path, step: int) -> Stamp:
    """The stamp of the policy of the fit at `step` and of the run's last."""
    return stamp(run / layout.policy(step), run / layout.POLICY)


def model(run: Path) -> Stamp:
    """The stamp of the files that `tom.analysis.imagine.stored_model` reads."""
    folders = [run / place for place in checkpoint.MODEL_PLACES]
    states = [path / checkpoint.STATE for place in folders for path in checkpoint.folders(place)]
    return stamp(run / layout.CONFIG, *states)


def _inside(run: Path, *names: str) -> Stamp:
    """The stamp of files of a run folder. Fast, because each page visit needs it for all runs."""
    folder = str(run)  # pathlib takes longer to join paths than the kernel to look them up
    return tuple(_of(f"{folder}/{name}") for name in names)


def _of(path: Path | str) -> tuple[int, int]:
    try:
        file = os.stat(path)  # noqa: PTH116
    except OSError:
        return (0, 0)
    return (file.st_mtime_ns, file.st_size)
