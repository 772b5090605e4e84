"""The live status of a run, `status.json`, and what its user calls it, `labels.json`."""

import time
from dataclasses import dataclass, fields
from typing import Any

BEAT_S = 2.0
"""seconds between two heartbeats"""

DEAD_AFTER_S = 30.0
"""seconds without heartbeat after which a running run counts as dead"""


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


@dataclass(frozen=True)
class Labels:
    """A display name, tags in order, and a note of several lines; all plain text, may be empty."""

    name: str = ""
    tags: tuple[str, ...] = ()
    note: str = ""


def status_of(content: dict[str, Any]) -> Status:
    """The status in a JSON object, of which a newer version may know more.

    Raises TypeError if its numbers are none.
    """
    known = {field.name: content[field.name] for field in fields(Status) if field.name in content}
    status = Status(**{**known, "warnings": tuple(known.get("warnings", ()))})
    _ = status.alive, status.share  # pages ask for both, where nobody expects an error
    return status


def labels_of(content: dict[str, Any]) -> Labels:
    return Labels(content.get("name", ""), tuple(content.get("tags", ())), content.get("note", ""))
