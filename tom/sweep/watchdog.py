"""When a training is given up because nothing is heard of it any more."""

import time
from collections.abc import Callable

from tom.record.status import Status
from tom.sweep.engine import Exit

LOST_AFTER_S = 60.0  # neither its machine nor its heart was heard for so long: it is given up


class Watchdog:
    """Measures how long a machine has been silent, by `clock` (s)."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._heard: float | None = None

    @property
    def started(self) -> bool:
        """Something was heard at least once; before that the training waits for a free core."""
        return self._heard is not None

    @property
    def silent_s(self) -> float:
        """Seconds since something was last heard; 0 before it has started."""
        return 0.0 if self._heard is None else self._clock() - self._heard

    def reset(self) -> None:
        """Something was heard just now: count from here."""
        self._heard = self._clock()


def lost(silent_s: float, status: Status) -> Exit | None:
    """The end of a training whose machine was silent for `silent_s`; None while it may live.

    Its heart in the run folder is proof of life, whatever its machine says to us.
    """
    if silent_s < LOST_AFTER_S or status.alive:
        return None
    return Exit(None, f"nothing was heard of its machine for {silent_s:.0f} s")
