"""When a training is given up because nothing is heard of it any more."""

import time
from collections.abc import Callable

from tom.record.status import Status
from tom.sweep.engine import Exit

LOST_AFTER_S = 60.0  # neither its machine nor its heart was heard for so long: it is given up


class Silence:
    """How long nothing was heard from a machine, by `clock` (s)."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._heard: float | None = None

    @property
    def begun(self) -> bool:
        """Something was heard at all: until then it waits for a free core."""
        return self._heard is not None

    @property
    def seconds(self) -> float:
        """Since something was heard; 0 before it has begun."""
        return 0.0 if self._heard is None else self._clock() - self._heard

    def broken(self) -> None:
        """Something is heard now."""
        self._heard = self._clock()


def lost(silent_s: float, status: Status) -> Exit | None:
    """The end of a training whose machine was silent for `silent_s`; None while it may live.

    Its heart in the run folder is proof of life, whatever its machine says to us.
    """
    if silent_s < LOST_AFTER_S or status.alive:
        return None
    return Exit(None, f"nothing was heard of its machine for {silent_s:.0f} s")
