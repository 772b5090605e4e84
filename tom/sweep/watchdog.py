"""When a training is given up because its machine is silent."""

import time
from collections.abc import Callable

from tom.record.status import Status
from tom.sweep.engine import Exit

LOST_AFTER_S = 60.0  # it is given up after this time without an answer or a heartbeat


class Watchdog:
    """Measures how long a machine has been silent, by `clock` (s)."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._heard: float | None = None

    @property
    def started(self) -> bool:
        """Whether the machine has ever answered; before that the training waits for a free core."""
        return self._heard is not None

    @property
    def silent_s(self) -> float:
        """Seconds since the last answer; 0 before the first one."""
        return 0.0 if self._heard is None else self._clock() - self._heard

    def reset(self) -> None:
        """The machine has answered: count from now."""
        self._heard = self._clock()


def lost(silent_s: float, status: Status) -> Exit | None:
    """The end of a training whose machine was silent for `silent_s`; None if it may still run.

    A recent heartbeat in the run folder proves that it runs, even if its machine does not answer.
    """
    if silent_s < LOST_AFTER_S or status.alive:
        return None
    return Exit(None, f"nothing was heard of its machine for {silent_s:.0f} s")
