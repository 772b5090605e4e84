"""The live status of a run, `status.json`, and the thread that keeps it fresh."""

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Any

BEAT_S = 2.0
"""seconds between two heartbeats"""

DEAD_AFTER_S = 30.0
"""seconds without heartbeat after which a running run counts as dead"""

WARNINGS = 8
"""kinds of notices that appear as warnings in the status"""

WINDOW_S = 120.0
"""seconds over which speed and remaining time are estimated"""


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
    """The status in a JSON object, of which a newer version may know more.

    Raises TypeError if its numbers are none.
    """
    known = {field.name: content[field.name] for field in fields(Status) if field.name in content}
    status = Status(**{**known, "warnings": tuple(known.get("warnings", ()))})
    _ = status.alive, status.share  # pages ask for both, where nobody expects an error
    return status


class Heartbeat:
    """Writes the status of one run every BEAT_S seconds, also during a model fit of minutes."""

    def __init__(
        self,
        write: Callable[[Status], None],
        status: Status,
        clock: Callable[[], float],
        timer: Callable[[], float],
    ) -> None:
        """Begin with `status`; `clock` gives unix seconds, `timer` monotonic seconds."""
        self.status = status
        self._write = write
        self._clock = clock
        self._timer = timer
        self._lock = threading.Lock()
        self._warnings: dict[str, str] = {}  # by kind, the newest last
        self._samples: deque[tuple[float, int]] = deque([(timer(), status.env_step)])
        self._stop = threading.Event()
        self.beat()
        self._thread = threading.Thread(target=self._run, name="heartbeat", daemon=True)
        self._thread.start()

    def tick(self, env_step: int, phase: str) -> None:
        """Note that the training is at `env_step`, in `phase`."""
        with self._lock:
            if phase != self.status.phase and self.status.phase == "explore":
                # Exploration is much faster than training, so it does not predict the time left.
                self._samples = deque([(self._timer(), env_step)])
            self.status = replace(self.status, env_step=env_step, phase=phase)

    def warn(self, kind: str, warning: str) -> None:
        """Add a warning for readers of the run; it replaces the last one of its kind."""
        with self._lock:
            self._warnings.pop(kind, None)
            self._warnings[kind] = warning
            newest = tuple(self._warnings.values())[-WARNINGS:]
            self.status = replace(self.status, warnings=newest)

    def evaluated(self, last_return: float) -> float:
        """Note the return of an evaluation; returns the best one so far."""
        with self._lock:
            best = self.status.best_return
            best = last_return if best is None else max(best, last_return)
            self.status = replace(self.status, last_return=last_return, best_return=best)
        return best

    def beat(self) -> None:
        """Write the status with a fresh heartbeat, speed and time left."""
        with self._lock:
            rate = self._rate(self._timer(), self.status.env_step)
            left = max(self.status.total - self.status.env_step, 0)
            self.status = replace(
                self.status,
                heartbeat=self._clock(),
                env_steps_per_s=rate,
                eta_s=left / rate if rate else None,
            )
            self._write(self.status)

    def stop(self) -> None:
        """Stop the thread."""
        self._stop.set()
        self._thread.join()

    def end(self, state: str, reason: str, seconds: float) -> None:
        """Write the final status, with the speed over the `seconds` of the whole run."""
        self.status = replace(
            self.status,
            state=state,
            reason=reason,
            phase="",
            heartbeat=self._clock(),
            eta_s=None,
            env_steps_per_s=self.status.env_step / seconds if seconds > 0 else None,
        )
        self._write(self.status)

    def _rate(self, now: float, step: int) -> float | None:
        """Env steps per second over the last WINDOW_S."""
        while len(self._samples) > 1 and now - self._samples[0][0] > WINDOW_S:
            self._samples.popleft()
        then, step_then = self._samples[0]
        self._samples.append((now, step))
        return (step - step_then) / (now - then) if now > then else None

    def _run(self) -> None:
        while not self._stop.wait(BEAT_S):
            try:
                self.beat()
            except OSError:  # the disk is full: the run looks dead until there is room again
                continue
