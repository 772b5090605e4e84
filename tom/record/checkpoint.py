"""Checkpoints: the state of a training, written atomically and loaded without executing code.

`checkpoint/<env_step>/` holds `state.pt` (tensors and primitives) and `manifest.json` with its
sha256. The folder is written under a temporary name, synced and renamed; the previous one stays
until the new one is whole, and two are kept: the disk never holds more than three. One flipped
byte would load as wrong numbers, so the hash is checked.
"""

import hashlib
import json
import os
import pickle
import re
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO, cast

from tom.data.unpack import cannot_read_now
from tom.errors import reason
from tom.record import layout
from tom.record.files import beside, read_json, set_aside, sync

SCHEMA = 1
FOLDER = "checkpoint"
KEPT = 2
STATE, MANIFEST = "state.pt", "manifest.json"
MODEL_PLACES = (FOLDER, layout.MODEL)
"""folders of a run that may hold its dynamics model"""
_STEP = re.compile(r"[0-9]{9,}")
"""the name of a checkpoint"""
UNUSABLE = (OSError, ValueError, pickle.UnpicklingError)
"""errors that loading a damaged checkpoint may raise; what its hash vouches for is torch's own"""


@dataclass(frozen=True)
class Checkpoint:
    """A loaded checkpoint; `unusable` are newer damaged ones, `problems` their errors."""

    env_step: int
    state: dict[str, Any]
    problems: list[str] = field(default_factory=list)
    unusable: list[Path] = field(default_factory=list)

    def set_unusable_aside(self, run: Path) -> None:
        """Move the unusable checkpoints away, so that they are not among the two that are kept.

        They may be whole: of a newer version, or on a disk that failed for a moment.
        """
        for path in self.unusable:
            set_aside(run, path)


def save(
    folder: Path, env_step: int, state: dict[str, Any], check: Callable[[], None] = lambda: None
) -> Path:
    """Write the checkpoint of `env_step` into `folder` and drop all but the last two.

    `check` is the check of the writer's lock: writing takes a while, and whoever has taken the run
    over meanwhile may have saved the same step. Raises its LostError, and OSError if the checkpoint
    does not fit the disk; then nothing of it remains and earlier checkpoints stay.
    """
    path = folder / f"{env_step:09d}"
    unfinished = beside(path)
    _drop_unfinished(folder)
    unfinished.mkdir(parents=True)
    try:
        manifest = {"schema": SCHEMA, "env_step": env_step, **_save_state(unfinished, state)}
        with (unfinished / MANIFEST).open("wb") as file:
            file.write(json.dumps(manifest, indent=1).encode())
            _sync_file(file)
        check()
        if path.exists():  # a resumed run writes this step again, with the same content
            shutil.rmtree(path)
        unfinished.rename(path)
    except BaseException:
        shutil.rmtree(unfinished, ignore_errors=True)
        raise
    sync(folder)
    for old in folders(folder)[KEPT:]:
        shutil.rmtree(old, ignore_errors=True)
    return path


def load(folder: Path) -> Checkpoint | None:
    """The newest undamaged checkpoint, or None."""
    return look_for(folder)[0]


def look_for(folder: Path) -> tuple[Checkpoint | None, str]:
    """The newest undamaged checkpoint, or None; and the problem of one that may be undamaged.

    That one could not be read for now; "" if there is no such one.
    """
    problems: list[str] = []
    unusable: list[Path] = []
    unread = ""
    try:
        listed = _listed(folder)
    except PermissionError as error:
        return None, f"{folder.name} cannot be read: {reason(error)}"
    for path in listed:
        try:
            state = _load_one(path)
        except UNUSABLE as error:
            problems.append(f"checkpoint {path.name} cannot be used: {reason(error)}")
            unusable.append(path)
            if cannot_read_now(error):
                unread = unread or f"checkpoint {path.name} cannot be read: {reason(error)}"
            continue
        return Checkpoint(int(path.name), state, problems, unusable), unread
    return None, unread


def load_model(run: Path) -> Checkpoint | None:
    """The newest undamaged checkpoint that has the run's model; a small copy has it alone."""
    checkpoints = (load(run / place) for place in MODEL_PLACES)
    return next((one for one in checkpoints if one is not None), None)


def is_whole(path: Path) -> bool:
    """Whether the content of the checkpoint `path` is what its manifest says."""
    try:
        with _whole(path):
            return True
    except UNUSABLE:
        return False


def newest(folder: Path) -> int | None:
    """The step of the newest checkpoint, damaged or not, or None."""
    checkpoints = folders(folder)
    return int(checkpoints[0].name) if checkpoints else None


def model_step(run: Path) -> int | None:
    """The step of the newest checkpoint that may have the run's model, damaged or not, or None."""
    steps = (newest(run / place) for place in MODEL_PLACES)
    return next((step for step in steps if step is not None), None)


class _Hashing:
    """A file for writing that also computes sha256 and length."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self.digest = hashlib.sha256()
        self.bytes = 0
        self.error: OSError | None = None

    def write(self, content: bytes) -> int:
        try:
            self._file.write(content)
        except OSError as error:  # torch would replace it by an error of its own
            self.error = error
            raise
        self.digest.update(content)
        self.bytes += len(content)
        return len(content)

    def flush(self) -> None:
        self._file.flush()


def _save_state(folder: Path, state: dict[str, Any]) -> dict[str, Any]:
    """Write the state; returns the manifest."""
    import torch  # takes a second to import; who lists checkpoints does without it

    with (folder / STATE).open("wb") as file:
        hashing = _Hashing(file)
        try:
            torch.save(state, cast(BinaryIO, hashing))
        except RuntimeError:
            raise hashing.error or OSError("torch could not write it") from None
        _sync_file(file)
    return {"sha256": hashing.digest.hexdigest(), "bytes": hashing.bytes}


@contextmanager
def _whole(path: Path) -> Iterator[BinaryIO]:
    """The open state of a checkpoint. Raises one of UNUSABLE unless it is as its manifest says."""
    manifest = read_json(path / MANIFEST)
    if manifest.get("schema") != SCHEMA:
        raise ValueError(f"schema {manifest.get('schema')} is not {SCHEMA}")
    with (path / STATE).open("rb") as file:
        if hashlib.file_digest(file, "sha256").hexdigest() != manifest.get("sha256"):
            raise ValueError("its content is torn or was altered (sha256 differs)")
        file.seek(0)
        yield file


def _load_one(path: Path) -> dict[str, Any]:
    import torch

    with _whole(path) as file:
        # On the CPU, so that it can be read on a machine without GPU.
        return torch.load(file, map_location="cpu", weights_only=True)


def folders(folder: Path) -> list[Path]:
    """The checkpoints in `folder`, newest first, damaged or not; none if it may not be entered."""
    try:
        return _listed(folder)
    except PermissionError:
        return []


def _listed(folder: Path) -> list[Path]:
    if not folder.is_dir():
        return []
    named = (path for path in folder.iterdir() if _STEP.fullmatch(path.name))
    checkpoints = [path for path in named if path.is_dir()]
    return sorted(checkpoints, key=lambda p: int(p.name), reverse=True)


def _drop_unfinished(folder: Path) -> None:
    """Remove the unfinished files of a killed process (we hold the run's lock)."""
    for path in folder.glob(".*.tmp"):
        shutil.rmtree(path, ignore_errors=True)


def _sync_file(file: BinaryIO) -> None:
    file.flush()
    os.fsync(file.fileno())
