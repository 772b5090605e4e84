"""Checkpoints: the state of a training, written atomically and loaded without executing code.

`checkpoint/<env_step>/` holds `state.pt` (tensors and primitives) and `manifest.json` with its
sha256. The folder is written under a temporary name, synced and renamed; the previous one stays
until the new one is whole, and two are kept: the disk never holds more than three. One flipped
byte would load as wrong numbers, so the hash is checked.
"""

import hashlib
import io
import pickle
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

from tom.data.unpack import cannot_read_now
from tom.errors import TryLaterError, reason
from tom.record import layout
from tom.record.files import read_json, replace, replace_json, sync, whole_folder

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
    """A loaded checkpoint."""

    env_step: int
    state: dict[str, Any]
    unusable: dict[Path, str] = field(default_factory=dict)
    """newer ones that cannot be used, each with its problem in one line"""


def save(folder: Path, env_step: int, state: dict[str, Any]) -> Path:
    """Write the checkpoint of `env_step` into `folder` and drop all but the last two.

    Raises OSError if it does not fit the disk; then nothing of it remains and earlier ones stay.
    """
    import torch  # takes a second to import; who lists checkpoints does without it

    path = folder / f"{env_step:09d}"
    for left in folder.glob(".*.tmp"):  # by a killed process: we hold the run's lock
        shutil.rmtree(left, ignore_errors=True)
    content = io.BytesIO()  # torch would replace the errors of a full disk by its own
    torch.save(state, content)
    with whole_folder(path) as unfinished:
        replace(unfinished / STATE, lambda file: file.write(content.getbuffer()), sync=True)
        digest, size = hashlib.sha256(content.getbuffer()).hexdigest(), len(content.getbuffer())
        manifest = {"schema": SCHEMA, "env_step": env_step, "sha256": digest, "bytes": size}
        replace_json(unfinished / MANIFEST, manifest, sync=True)
        if path.exists():  # a resumed run writes this step again, with the same content
            shutil.rmtree(path)
    sync(folder)
    for old in folders(folder)[KEPT:]:
        shutil.rmtree(old, ignore_errors=True)
    return path


def load(folder: Path) -> Checkpoint | None:
    """The newest undamaged checkpoint, or None.

    Raises TryLaterError if one cannot be read for now: it may be whole, and newer than the others.
    """
    import torch

    unusable: dict[Path, str] = {}
    path = folder
    try:
        if folder.is_dir():
            list(folder.iterdir())  # raises where it may not be entered
        for path in folders(folder):
            try:
                with _whole(path) as file:
                    # On the CPU, so that it can be read on a machine without GPU.
                    state = torch.load(file, map_location="cpu", weights_only=True)
                return Checkpoint(int(path.name), state, unusable)
            except UNUSABLE as error:
                if cannot_read_now(error):
                    raise
                unusable[path] = f"checkpoint {path.name} cannot be used: {reason(error)}"
    except OSError as error:
        raise TryLaterError(
            f"{folder.parent.name}: {path.relative_to(folder.parent)}: {reason(error)}, so it "
            "cannot be read for now: check the disk and try again"
        ) from None
    return None


def load_model(run: Path) -> Checkpoint | None:
    """The newest undamaged checkpoint that has the run's model; a small copy has it alone.

    Raises the error of `load`.
    """
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


def folders(folder: Path) -> list[Path]:
    """The checkpoints in `folder`, newest first, damaged or not; none if it may not be entered."""
    try:
        found = [path for path in folder.iterdir() if _STEP.fullmatch(path.name) and path.is_dir()]
    except (FileNotFoundError, NotADirectoryError, PermissionError):
        return []
    return sorted(found, key=lambda path: int(path.name), reverse=True)


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
