"""A thread that keeps `status.json` fresh, also during a model fit of minutes."""

import os
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace

from tom.record.status import BEAT_S, Status
from tom.record.writer import RunWriter

WARNINGS = 8
"""kinds of notices that appear as warnings in the status"""

WINDOW_S = 120.0
"""seconds over which speed and remaining time are estimated"""


@dataclass(frozen=True)
class Begun:
    """The progress of a run when its heartbeat starts; not zero for a resumed run."""

    env_step: int = 0
    last_return: float | None = None
    best_return: float | None = None
    wall_s: float = 0.0


class Heartbeat:
    """The live status of one run."""

    def __init__(
        self,
        writer: RunWriter,
        total: int,
        clock: Callable[[], float],
        timer: Callable[[], float],
        begun: Begun,
    ) -> None:
        """`clock` gives unix seconds, `timer` monotonic seconds."""
        self._writer = writer
        self._clock = clock
        self._timer = timer
        self._lock = threading.Lock()
        now = clock()
        self.status = Status(
            state="running",
            phase="start",
            env_step=begun.env_step,
            total=total,
            heartbeat=now,
            started=now,
            pid=os.getpid(),
            last_return=begun.last_return,
            best_return=begun.best_return,
        )
        self._begun = timer() - begun.wall_s
        self._warnings: dict[str, str] = {}  # by kind, the newest last
        self._samples: deque[tuple[float, int]] = deque([(timer(), begun.env_step)])
        self._stop = threading.Event()
        self.beat()
        self._thread = threading.Thread(target=self._run, name="heartbeat", daemon=True)
        self._thread.start()

    def tick(self, env_step: int, phase: str) -> None:
        """Tell that the training is at `env_step`, in `phase`."""
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

    def returned(self, value: float) -> float:
        """Tell an evaluation's return; gives back the best return so far."""
        with self._lock:
            before = self.status.best_return
            best = value if before is None or value > before else before
            self.status = replace(self.status, last_return=value, best_return=best)
        return best

    @property
    def returns(self) -> tuple[float | None, float | None]:
        """The last and the best return."""
        return self.status.last_return, self.status.best_return

    def beat(self) -> None:
        """Write the status with a fresh heartbeat, speed and time left."""
        with self._lock:
            step = self.status.env_step
            rate = self._rate(self._timer(), step)
            left = max(self.status.total - step, 0)
            self.status = replace(
                self.status,
                heartbeat=self._clock(),
                env_steps_per_s=rate,
                eta_s=left / rate if rate else None,
            )
            self._writer.status(self.status)

    def stop(self) -> None:
        """Stop the thread."""
        self._stop.set()
        self._thread.join()

    def end(self, state: str, reason: str) -> None:
        """Write the final status, with the speed of the whole run."""
        span = self._timer() - self._begun
        rate = self.status.env_step / span if span > 0 else None
        beat = self._clock()
        ended = replace(self.status, state=state, reason=reason, heartbeat=beat, phase="")
        self.status = replace(ended, eta_s=None, env_steps_per_s=rate)
        self._writer.status(self.status)

    def _rate(self, now: float, step: int) -> float | None:
        while len(self._samples) > 1 and now - self._samples[0][0] > WINDOW_S:
            self._samples.popleft()
        then, step_then = self._samples[0]
        self._samples.append((now, step))
        return (step - step_then) / (now - then) if now > then else None

    def _run(self) -> None:
        while not self._stop.wait(BEAT_S):
            try:
                self.beat()
            except OSError:
                # The disk is full: the run looks dead until there is room again, but goes on.
                continue
