"""The Rerun recording of a run, written in the background: training never waits for it.

Only `run.rrd` is written here. A live viewer is fed by the studio's hub from the run folder
(feed.py), so a training cannot notice a viewer that is absent, slow or dead.
"""

import queue
import threading
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from tom.config import EvaluationConfig
from tom.data.transitions import Transitions
from tom.envs import ROAD
from tom.events import Evaluation, Field, Weights
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


class Sink(Protocol):
    """A best-effort view of the run. No method waits or raises."""

    def metrics(self, env_step: int, values: Mapping[str, float]) -> None: ...

    def weights(self, weights: Weights, bins: NDArray[np.float64]) -> None: ...

    def rows(self, rows: Transitions) -> None: ...

    def evaluation(self, evaluation: Evaluation) -> None: ...

    def field(self, field: Field) -> None: ...

    def close(self) -> str | None:
        """End the view; returns a notice if data was left out."""
        ...


class RerunSink:
    """Writes one run's recording in a thread; drops entries that do not fit its queue."""

    def __init__(self, path: Path, run_id: str, env: str, learner: str, every: int) -> None:
        """Record into `path`, a new file; `every` env steps lie between two evaluations."""
        self.path = path
        self._mapped = env == ROAD
        self.dropped = 0
        self._error: str | None = None
        self._queue: queue.Queue[Callable[[RerunView], object] | None] = queue.Queue(CAPACITY)
        self._thread = threading.Thread(
            target=self._run, args=(run_id, env, learner, every), name="rerun", daemon=True
        )
        self._thread.start()

    def metrics(self, env_step: int, values: Mapping[str, float]) -> None:
        self._offer(lambda view: view.metrics(env_step, values))

    def weights(self, weights: Weights, bins: NDArray[np.float64]) -> None:
        self._offer(lambda view: view.profile(weights.env_step, bins))
        if self._mapped:
            self._offer(lambda view: view.weights(weights.env_step, weights.weight))

    def rows(self, rows: Transitions) -> None:
        if self._mapped:  # the map's data come first, all at once
            self._offer(lambda view: view.places(np.asarray(rows.obs)))

    def evaluation(self, evaluation: Evaluation) -> None:
        first = Evaluation(evaluation.env_step, evaluation.episodes[:1])
        self._offer(lambda view: view.evaluation(first))

    def field(self, field: Field) -> None:
        self._offer(lambda view: view.field(field))

    def close(self) -> str | None:
        if not self._ended():
            _leave_behind()
            return f"{self.path.name} did not take what was recorded and may be incomplete"
        if self._error:
            return f"{self.path.name} is incomplete: {self._error}"
        if self.dropped:
            return f"{self.path.name} was too slow: {self.dropped} entries were left out"
        return None

    def _ended(self) -> bool:
        """Whether the thread has finished in time, after all entries."""
        with suppress(queue.Full):  # the thread hangs, which is checked below
            self._queue.put(None, timeout=CLOSE_S)
            self._thread.join(CLOSE_S)
        return not self._thread.is_alive()

    def _offer(self, entry: Callable[["RerunView"], object]) -> None:
        try:
            self._queue.put_nowait(entry)
        except queue.Full:
            self.dropped += 1

    def _run(self, run_id: str, env: str, learner: str, every: int) -> None:
        """Process the queue; an entry that fails does not stop the others."""
        view = self._attempt(lambda: _view(self.path, run_id, env, learner, every))
        while (entry := self._queue.get()) is not None:
            if view is not None:
                self._attempt(partial(entry, view))
        if view is not None:
            self._attempt(lambda: view.close(CLOSE_S / 2))

    def _attempt(self, step: Callable[[], T]) -> T | None:
        try:
            return step()
        except Exception as error:  # training goes on without Rerun, whatever it raises
            self._error = self._error or f"{type(error).__name__}: {error}"
            return None


def open_sink(writer: RunWriter) -> Sink:
    """The Rerun recording of the run of `writer`, in a new file."""
    config = writer.config
    evaluation = getattr(config, "evaluation", None) or EvaluationConfig()
    path = layout.next_rrd(writer.path)
    return RerunSink(path, writer.run_id, config.env, config.learner, evaluation.every)


def _view(path: Path, run_id: str, env: str, learner: str, every: int) -> "RerunView":
    # Imported here because it takes half a second.
    import rerun as rr

    from tom.record.rerun.view import RerunView

    return RerunView(run_id, env, learner, every, rr.FileSink(path), run=RunReader(path.parent))


def _leave_behind() -> None:
    """Let the process end although Rerun still holds unwritten data."""
    import rerun as rr

    rr.unregister_shutdown()
