"""The Rerun recording of a run, written in the background: training never waits for it.

Only `run.rrd` is written here. A live viewer is fed by the studio's hub from the run folder
(feed.py), so a training cannot notice a viewer that is absent, slow or dead.
"""

import queue
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from tom.record import layout
from tom.record.reader import RunReader
from tom.record.writer import RunWriter

if TYPE_CHECKING:
    from tom.record.rerun.view import RerunView

T = TypeVar("T")

CAPACITY = 256
"""maximum number of entries waiting for the background thread; more are dropped"""

CLOSE_S = 10.0
"""seconds that the end of a run waits for its recording"""


class RerunSink:
    """Writes one run's recording in a thread; drops entries that do not fit its queue."""

    def __init__(self, path: Path) -> None:
        """Record into `path`, a new file in the run folder."""
        self.path = path
        self.dropped = 0
        self._error: str | None = None
        self._queue: queue.Queue[Callable[[RerunView], object] | None] = queue.Queue(CAPACITY)
        self._thread = threading.Thread(target=self._run, name="rerun", daemon=True)
        self._thread.start()

    def put(self, draw: Callable[["RerunView"], object]) -> None:
        """Let the thread call `draw` with the view. Neither waits nor raises."""
        try:
            self._queue.put_nowait(draw)
        except queue.Full:
            self.dropped += 1

    def close(self) -> str | None:
        """End the recording; returns a notice if data was left out."""
        with suppress(queue.Full):  # the thread hangs, which is checked below
            self._queue.put(None, timeout=CLOSE_S)
            self._thread.join(CLOSE_S)
        if self._thread.is_alive():
            import rerun as rr

            rr.unregister_shutdown()  # else the process could not end while Rerun holds data
            return f"{self.path.name} did not take what was recorded and may be incomplete"
        if self._error:
            return f"{self.path.name} is incomplete: {self._error}"
        if self.dropped:
            return f"{self.path.name} was too slow: {self.dropped} entries were left out"
        return None

    def _run(self) -> None:
        """Process the queue; an entry that fails does not stop the others."""

        def opened() -> "RerunView":
            import rerun as rr  # takes half a second

            from tom.record.rerun.view import RerunView

            return RerunView(RunReader(self.path.parent), rr.FileSink(self.path))

        view = self._attempt(opened)
        while (draw := self._queue.get()) is not None:
            if view is not None:
                self._attempt(lambda draw=draw: draw(view))
        if view is not None:
            self._attempt(lambda: view.close(CLOSE_S / 2))

    def _attempt(self, step: Callable[[], T]) -> T | None:
        try:
            return step()
        except Exception as error:  # training goes on without Rerun, whatever it raises
            self._error = self._error or f"{type(error).__name__}: {error}"
            return None


def open_sink(writer: RunWriter) -> RerunSink:
    """The Rerun recording of the run of `writer`, in a new file."""
    return RerunSink(layout.next_rrd(writer.path))
