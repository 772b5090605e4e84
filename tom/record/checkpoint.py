"""Checkpoints: where a training stands, whole or not at all, loaded without executing code.

`checkpoint/<env_step>/` holds `state.pt` (tensors and primitives) and `manifest.json` with its
sha256. The folder is written under a temporary name, synced and renamed; the previous one stays
until the new one is whole. One flipped byte would load as wrong numbers, so the hash is checked.
"""

import hashlib
import io
import json
import os
import pickle
import shutil
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

SCHEMA = 1
FOLDER = "checkpoint"
KEPT = 2
STATE, MANIFEST = "state.pt", "manifest.json"


@dataclass(frozen=True)
class Checkpoint:
    """A loaded checkpoint; `problems` names those that were newer but could not be used."""

    env_step: int
    state: dict[str, Any]
    problems: list[str] = field(default_factory=list)


def save(folder: Path, env_step: int, state: dict[str, Any]) -> Path:
    """Write the checkpoint of `env_step` into `folder` and drop all but the last two."""
    content = io.BytesIO()
    torch.save(state, content)
    manifest = {
        "schema": SCHEMA,
        "env_step": env_step,
        "sha256": hashlib.sha256(content.getbuffer()).hexdigest(),
        "bytes": content.tell(),
    }
    unfinished = folder / f".{env_step:09d}.{os.getpid()}.tmp"
    shutil.rmtree(unfinished, ignore_errors=True)
    unfinished.mkdir(parents=True)
    try:
        _write(unfinished / STATE, content.getbuffer())
        _write(unfinished / MANIFEST, json.dumps(manifest, indent=1).encode())
        path = folder / f"{env_step:09d}"
        if path.exists():  # a resumed run comes by here again, with the same content
            shutil.rmtree(path)
        unfinished.rename(path)
    except OSError:
        shutil.rmtree(unfinished, ignore_errors=True)
        raise
    _sync(folder)
    for old in _folders(folder)[KEPT:]:
        shutil.rmtree(old, ignore_errors=True)
    return path


def load(folder: Path) -> Checkpoint | None:
    """The newest checkpoint that is whole; None where there is none."""
    problems: list[str] = []
    for path in _folders(folder):
        try:
            state = _load_one(path)
        except (OSError, ValueError, RuntimeError, EOFError, pickle.UnpicklingError) as error:
            problems.append(f"checkpoint {path.name} cannot be used: {error}")
            continue
        return Checkpoint(int(path.name), state, problems)
    return None


def _load_one(path: Path) -> dict[str, Any]:
    manifest = json.loads((path / MANIFEST).read_text())
    if manifest.get("schema") != SCHEMA:
        raise ValueError(f"schema {manifest.get('schema')} is not {SCHEMA}")
    content = (path / STATE).read_bytes()
    if hashlib.sha256(content).hexdigest() != manifest["sha256"]:
        raise ValueError("its content is torn or was altered (sha256 differs)")
    return torch.load(io.BytesIO(content), weights_only=True)


def _folders(folder: Path) -> list[Path]:
    """The checkpoint folders, newest first."""
    if not folder.is_dir():
        return []
    found = [p for p in folder.iterdir() if p.name.isdigit() and p.is_dir()]
    return sorted(found, key=lambda p: int(p.name), reverse=True)


def _write(path: Path, content: bytes | memoryview) -> None:
    with path.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())


def _sync(folder: Path) -> None:
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
