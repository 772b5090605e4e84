"""The Rerun recording of a run, written by a thread of the training from the run folder.

So training never waits for it, and it has what a live viewer gets from the studio's hub (feed.py).
"""

import threading
from pathlib import Path

from tom.record import layout
from tom.record.reader import RunReader

CLOSE_S = 10.0
"""seconds that the end of a run waits for its recording"""


class RerunSink:
    """Writes what a run records from `start` on into a file of its folder."""

    def __init__(self, run: Path) -> None:
        last = [path.stem.partition("-")[2] for path in layout.rrd_files(run)[-1:]]
        # Recordings are never overwritten.
        self.path = run / (f"run-{int(last[0] or 1) + 1}.rrd" if last else "run.rrd")
        self._run = RunReader(run)
        self._error = ""
        self._ending = threading.Event()
        self._thread: threading.Thread | None = None

    def start(self, after: int = -1) -> None:
        """Begin with the rows that are written from now on, and the files of steps after `after`.

        A resumed run has earlier ones in an earlier recording.
        """
        paths = [self._run.path / name for name in (layout.METRICS, layout.PROFILES)]
        offsets = [path.stat().st_size for path in paths]
        self._thread = threading.Thread(
            target=self._record, args=(after, offsets), name="rerun", daemon=True
        )
        self._thread.start()

    def close(self) -> str | None:
        """End the recording; returns a notice if data was left out."""
        self._ending.set()
        if self._thread is not None:
            self._thread.join(CLOSE_S)
            if self._thread.is_alive():
                import rerun as rr

                rr.unregister_shutdown()  # else the process could not end while Rerun holds data
                return f"{self.path.name} did not take what was recorded and may be incomplete"
        return f"{self.path.name} is incomplete: {self._error}" if self._error else None

    def _record(self, after: int, offsets: list[int]) -> None:
        try:
            import rerun as rr  # takes half a second

            from tom.record.rerun.feed import POLL_S, Follower

            follower = Follower(self._run, rr.FileSink(self.path), after, offsets)
            ended = False
            while not ended:
                ended = self._ending.wait(POLL_S)
                for _ in follower.follow():
                    pass
            follower.close(CLOSE_S / 2)
        except Exception as error:  # training goes on without Rerun, whatever it raises
            self._error = f"{type(error).__name__}: {error}"
