"""The live status of a run: `status.json`."""

import time
from dataclasses import dataclass, fields
from typing import Any, TypeGuard

BEAT_S = 2.0
"""seconds between two heartbeats"""

DEAD_AFTER_S = 30.0
"""seconds without heartbeat after which a running run counts as dead"""

HUGE = 2**62


@dataclass(frozen=True)
class Status:
    """The fields of `status.json`; `state` is `unknown` if the file is missing or damaged."""

    state: str = "unknown"
    phase: str = ""
    env_step: int = 0
    total: int = 0
    heartbeat: float = 0.0  # unix seconds
    started: float = 0.0  # unix seconds
    pid: int = 0
    reason: str = ""  # why it stopped or failed, at which step, and what to try
    warnings: tuple[str, ...] = ()  # the last notice of each kind: step, what, and what to try
    eta_s: float | None = None
    env_steps_per_s: float | None = None
    last_return: float | None = None
    best_return: float | None = None

    @property
    def alive(self) -> bool:
        """Whether the run is running with a fresh heartbeat."""
        # A heartbeat in the future is from a wrong clock, or from before a correction of the clock.
        return self.state == "running" and abs(time.time() - self.heartbeat) <= DEAD_AFTER_S

    @property
    def shown(self) -> str:
        """The state for readers: `dead` for a running run without heartbeat."""
        return "dead" if self.state == "running" and not self.alive else self.state

    @property
    def share(self) -> float:
        """The completed share of the run, in [0, 1]."""
        return min(self.env_step / self.total, 1.0) if self.total > 0 else 0.0


def parse(content: dict[str, Any]) -> Status:
    """The status in a JSON object. Raises ValueError that names the first wrong field."""
    known: dict[str, Any] = {}
    for field in fields(Status):
        if field.name in content:
            known[field.name] = _checked(field.name, content[field.name])
    return Status(**known)


def _checked(name: str, value: Any) -> Any:
    if name in ("state", "phase", "reason"):
        if isinstance(value, str):
            return value
    elif name == "warnings":
        if isinstance(value, list) and all(isinstance(text, str) for text in value):
            return tuple(value)
    elif name in ("env_step", "total", "pid"):
        if _number(value):
            return int(value)
    elif _number(value) or (value is None and name not in ("heartbeat", "started")):
        return value
    raise ValueError(f"{name} is {value!r}")


def _number(value: Any) -> TypeGuard[int | float]:
    if not isinstance(value, int | float) or isinstance(value, bool):
        return False
    return abs(value) < HUGE  # finite, and within the range of a clock or an array
