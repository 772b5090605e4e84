"""What a small copy (`thin` writes it) says of itself: `thinned` in `config.json`, its status."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from tom.record.status import Status

KEY = "thinned"
NAME = "a small copy"


def is_one(config: Mapping[str, Any]) -> bool:
    """It is the configuration of a small copy."""
    return KEY in config


def left_out(config: Mapping[str, Any]) -> tuple[str, ...]:
    """The parts that the run had and its small copy has not; of `other ...` it holds some."""
    note = config.get(KEY)
    names = note.get("left_out") if isinstance(note, dict) else None
    return tuple(name for name in names if isinstance(name, str)) if isinstance(names, list) else ()


def shown(status: Status, small: bool) -> str:
    """The state in words: `finished`, or `finished (a small copy)`."""
    return f"{status.shown} ({NAME})" if small else status.shown


def status_of(running: Status, env_step: int) -> Status:
    """What the copy at `env_step` of a run that says it is running says: nobody trains the copy."""
    why = "while it was training" if running.alive else "after its process ended without a word"
    reason = f"copied at step {env_step} {why}"
    return replace(running, state="stopped", phase="", env_step=env_step, reason=reason, eta_s=None)
