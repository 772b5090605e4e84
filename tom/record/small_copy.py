"""How a small copy of a run (written by `thin`) differs for readers: `thinned` in `config.json`."""

from collections.abc import Mapping
from typing import Any

from tom.record.status import Status

KEY = "thinned"
NAME = "a small copy"


def is_one(config: Mapping[str, Any]) -> bool:
    """Whether it is the configuration of a small copy."""
    return KEY in config


def left_out(config: Mapping[str, Any]) -> tuple[str, ...]:
    """The parts of the run that its small copy lacks; of `other ...` it has some."""
    return tuple(config.get(KEY, {}).get("left_out", ()))


def shown(status: Status, small: bool) -> str:
    """The state in words: `finished`, or `finished (a small copy)`."""
    return f"{status.shown} ({NAME})" if small else status.shown
