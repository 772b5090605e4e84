"""What a run's `config.json` says of a small copy (`thin` writes it) under `thinned`."""

from collections.abc import Mapping
from typing import Any

KEY = "thinned"


def is_one(config: Mapping[str, Any]) -> bool:
    """It is the configuration of a small copy."""
    return KEY in config


def left_out(config: Mapping[str, Any]) -> tuple[str, ...]:
    """The parts that the run had and its small copy has not; of `other ...` it holds some."""
    note = config.get(KEY)
    names = note.get("left_out") if isinstance(note, dict) else None
    return tuple(name for name in names if isinstance(name, str)) if isinstance(names, list) else ()
