"""How long a run that another machine writes is left to it, by this machine's own clock.

Two machines' clocks may differ by any amount, so a heartbeat's time says nothing here: what counts
is when this machine saw it change.
"""

import time
from collections.abc import Callable


class Lease:
    """What was last seen of each run, and since when by `clock` (s, never decreasing)."""

    def __init__(self, lasts_s: float, clock: Callable[[], float] = time.monotonic) -> None:
        """A run is left to its writer until it was seen unchanged for `lasts_s`."""
        self._lasts_s = lasts_s
        self._clock = clock
        self._seen: dict[str, tuple[object, float]] = {}

    def see(self, run_id: str, sign: object) -> None:
        """Note what changes while the run is written; None: nobody claims to write it."""
        if run_id not in self._seen or self._seen[run_id][0] != sign:
            self._seen[run_id] = (sign, self._clock())

    def holds(self, run_id: str) -> bool:
        """Whether the run is to be left to its writer."""
        sign, since = self._seen.get(run_id, (None, 0.0))
        return sign is not None and self._clock() - since < self._lasts_s

    def forget(self) -> None:
        """Count all runs anew, because none of them could be seen for a while."""
        self._seen.clear()
