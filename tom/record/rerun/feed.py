"""Live Rerun recordings for each viewer, of one run or of all running ones, from run folders.

It reads run folders like any reader: trainings do not know of it, and it may start late.
"""

import logging
import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr

from tom.envs import ROAD
from tom.errors import UserError
from tom.events import Evaluation, Field
from tom.record import layout
from tom.record.decode import numbers, profiles_of
from tom.record.files import parse_json_line
from tom.record.reader import RunReader
from tom.record.rerun.view import RerunView
from tom.record.status import DEAD_AFTER_S
from tom.record.store import Store

POLL_S = 1.0
FLUSH_S = 2.0
BLOCK_BYTES = 1_000_000

_log = logging.getLogger(__name__)


class Tail:
    """The new rows of a JSON lines file since the last call."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._offset = 0

    def blocks(self) -> Iterator[list[dict[str, Any]]]:
        """New complete rows in blocks of a megabyte, until there are no more for now.

        Damaged rows are skipped. A file that became shorter is read again from the start.
        """
        while whole := self._next_block():
            rows = map(parse_json_line, whole.splitlines())
            yield [row for row in rows if row and isinstance(row.get("env_step"), int)]

    def _next_block(self) -> bytes:
        """Some complete lines; empty if there are no new ones."""
        try:
            with self._path.open("rb") as file:
                size = file.seek(0, os.SEEK_END)
                if size < self._offset:  # a resumed run writes the following rows again
                    self._offset = file.seek(0)
                file.seek(self._offset)
                text = file.read(BLOCK_BYTES)
                while text and b"\n" not in text and (more := file.read(BLOCK_BYTES)):
                    text += more
        except OSError:  # it does not exist yet
            return b""
        whole = text[: text.rfind(b"\n") + 1]
        self._offset += len(whole)
        return whole


class Follower:
    """The state of one run's live recording."""

    def __init__(self, run: RunReader, sink: rr.FileSink | None = None) -> None:
        self.run = run
        self._view = RerunView(run.run_id, run.env, run.learner, _every(run), sink, run=run)
        self._metrics = Tail(run.path / layout.METRICS)
        self._profiles = Tail(run.path / layout.PROFILES)
        self._placed = False
        self._shown: set[tuple[str, int]] = set()

    def follow(self) -> Iterator[None]:
        """Send new data piece by piece, because a long run would be gigabytes at once."""
        for rows in self._metrics.blocks():
            for row in rows:
                self._view.metrics(row["env_step"], numbers(row))
            self._view.flush()
            yield
        for rows in self._profiles.blocks():
            profiles = profiles_of(rows)
            for step, bins in zip(profiles.env_step.tolist(), profiles.bins, strict=True):
                self._view.profile(step, bins)
            yield
        if self.run.env == ROAD:
            yield from self._follow_weights()
        for name in self.run.field_names():
            for step in self._new(name, self.run.field_steps(name)):
                with self._passing_over(layout.field(name, step)):
                    self._view.field(Field(step, name, self.run.field(name, step)))
                yield
        for step in self._new("", self.run.evaluation_steps()):
            with self._passing_over(layout.episodes(step)):
                self._view.evaluation(Evaluation(step, self.run.episodes(step)))
            yield

    def _follow_weights(self) -> Iterator[None]:
        if not self._placed:
            rows, _ = self.run.buffer()
            if not len(rows):
                return
            self._placed = True
            with self._passing_over("buffer"):
                self._view.places(np.asarray(rows.obs))
        for step in self._new("weights", self.run.snapshot_steps()):
            with self._passing_over(layout.snapshot(step)):
                self._view.weights(step, self.run.snapshot(step)["weight"].to_numpy())
            yield

    @contextmanager
    def _passing_over(self, name: str) -> Iterator[None]:
        """If a file of the run cannot be shown, print its name and go on with the others."""
        try:
            yield
        except (UserError, LookupError, TypeError, ValueError, OverflowError) as error:
            _log.warning("%s of %s is left out of Rerun: %s", name, self.run.run_id, error)

    def pieces(self) -> Iterator[bytes]:
        """New data as bytes, if there is no sink."""
        for _ in self.follow():
            yield self._view.read()
        yield self._view.read()

    def close(self, within_s: float = FLUSH_S) -> None:
        """Flush the remaining data. Raises RuntimeError if this takes too long."""
        self._view.close(within_s)

    def _new(self, kind: str, steps: list[int]) -> list[int]:
        new = [step for step in steps if (kind, step) not in self._shown]
        self._shown |= {(kind, step) for step in new}
        return new


def _every(run: RunReader) -> int:
    """Env steps between two evaluations."""
    settings = run.config.get("config")
    evaluation = settings.get("evaluation") if isinstance(settings, dict) else None
    every = evaluation.get("every") if isinstance(evaluation, dict) else None
    return max(every, 1) if isinstance(every, int) else 1000


def stream(run: RunReader, stopping: threading.Event) -> Iterator[bytes]:
    """The bytes of a recording that grows and ends with the run; empty bytes between updates."""
    follower = Follower(run)
    while not stopping.is_set():
        alive = RunReader(
            run.path
        ).status.alive  # read before the rows, so that later rows are not missed
        yield from follower.pieces()
        if not alive:
            return
        yield b""
        stopping.wait(POLL_S)


def stream_all(store: Store, stopping: threading.Event) -> Iterator[bytes]:
    """The bytes of the recordings of all running trainings, also of those that start later."""
    trainings = Trainings(store)
    while not stopping.is_set():
        yield from trainings.pieces()
        yield b""
        stopping.wait(POLL_S)


class Trainings:
    """The live recordings of the running trainings of `store` for one viewer."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._followers: dict[str, Follower] = {}
        self._done: dict[str, float] = {}  # run id -> start time of the finished recording

    @property
    def followed(self) -> list[str]:
        """The ids of the runs that are shown."""
        return list(self._followers)

    def pieces(self) -> Iterator[bytes]:
        """The new data in the store.

        A run that cannot be shown is printed once and does not stop the others.
        """
        for run_id in dict.fromkeys([*self._store.recent(DEAD_AFTER_S), *self._followers]):
            try:
                yield from self._follow(run_id)
            except Exception as error:
                _log.warning("cannot show %s in Rerun: %s", run_id, error)
                self._end(run_id, RunReader(self._store.path / run_id).status.started)

    def _follow(self, run_id: str) -> Iterator[bytes]:
        run = self._store.run(run_id)
        status = run.status  # read before the rows, so that later rows are not missed
        if self._done.get(run_id) == status.started:
            return
        if run_id not in self._followers:
            self._followers[run_id] = Follower(run)
        yield from self._followers[run_id].pieces()
        if not status.alive:
            self._end(run_id, status.started)

    def _end(self, run_id: str, started: float) -> None:
        self._done[run_id] = started
        self._followers.pop(run_id, None)
