"""Turns run folders into live Rerun recordings, of one run or of all that train, for each viewer.

It reads as any reader does: trainings know nothing of it, and it may start late.
"""

import logging
import os
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr

from tom.envs import ENVS
from tom.events import Evaluation, Field
from tom.record import layout
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
    """The rows that a JSON lines file has gained since the last look."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._offset = 0

    def blocks(self) -> Iterator[list[dict[str, Any]]]:
        """New whole rows, a megabyte of them at a time, until there are no more for now.

        Damaged rows are passed over. A file that was cut starts again.
        """
        while whole := self._next_block():
            rows = map(parse_json_line, whole.splitlines())
            yield [row for row in rows if row and isinstance(row.get("env_step"), int)]

    def _next_block(self) -> bytes:
        """Some whole lines; empty where there are no new ones."""
        try:
            with self._path.open("rb") as file:
                size = file.seek(0, os.SEEK_END)
                if size < self._offset:  # a resumed run writes what follows once more
                    self._offset = file.seek(0)
                file.seek(self._offset)
                text = file.read(BLOCK_BYTES)
                while text and b"\n" not in text and (more := file.read(BLOCK_BYTES)):
                    text += more
        except FileNotFoundError:
            return b""
        whole = text[: text.rfind(b"\n") + 1]
        self._offset += len(whole)
        return whole


class Follower:
    """What one run has shown so far."""

    def __init__(self, run: RunReader, sink: rr.FileSink | None = None) -> None:
        self.run = run
        config = run.config.get("config", {})
        every = int(config.get("evaluation", {}).get("every", 1000))
        self._view = RerunView(run.run_id, run.env, run.learner, every, sink)
        self._metrics = Tail(run.path / layout.METRICS)
        self._profiles = Tail(run.path / layout.PROFILES)
        self._placed = False
        self._shown: set[tuple[str, int]] = set()

    def follow(self) -> Iterator[None]:
        """Send what is new, piece by piece: all of a long run would be gigabytes at once."""
        for rows in self._metrics.blocks():
            for row in rows:
                values = {k: v for k, v in row.items() if k != "env_step" and v is not None}
                self._view.metrics(row["env_step"], values)
            self._view.flush()
            yield
        for rows in self._profiles.blocks():
            for row in rows:
                self._view.profile(row["env_step"], np.array(row["bins"], np.float64))
            yield
        if self.run.env not in ENVS:
            yield from self._follow_weights()
        for name in self.run.field_names():
            for step in self._new(name, self.run.field_steps(name)):
                self._view.field(Field(step, name, self.run.field(name, step)))
                yield
        for step in self._new("", self.run.evaluation_steps()):
            self._view.evaluation(Evaluation(step, self.run.episodes(step)))
            yield

    def _follow_weights(self) -> Iterator[None]:
        if not self._placed:
            rows, _ = self.run.buffer()
            if not len(rows):
                return
            self._view.places(np.asarray(rows.obs))
            self._placed = True
        for step in self._new("weights", self.run.snapshot_steps()):
            self._view.weights(step, self.run.snapshot(step)["weight"].to_numpy())
            yield

    def pieces(self) -> Iterator[bytes]:
        """What is new as bytes, where there is no sink."""
        for _ in self.follow():
            yield self._view.read()
        yield self._view.read()

    def close(self, within_s: float = FLUSH_S) -> None:
        """Hand over what is left. Raises RuntimeError where it is not taken in time."""
        self._view.close(within_s)

    def _new(self, kind: str, steps: list[int]) -> list[int]:
        new = [step for step in steps if (kind, step) not in self._shown]
        self._shown |= {(kind, step) for step in new}
        return new


def stream(run: RunReader, stopping: threading.Event) -> Iterator[bytes]:
    """The bytes of a recording that grows with the run and ends with it; none between two looks."""
    follower = Follower(run)
    while not stopping.is_set():
        alive = run.status.alive  # before the rows: what comes later is not missed
        yield from follower.pieces()
        if not alive:
            return
        yield b""
        stopping.wait(POLL_S)


def stream_all(store: Store, stopping: threading.Event) -> Iterator[bytes]:
    """The bytes of the recordings of all runs that train, those too that begin later."""
    trainings = Trainings(store)
    while not stopping.is_set():
        yield from trainings.pieces()
        yield b""
        stopping.wait(POLL_S)


class Trainings:
    """What one viewer has been shown of the runs of `store` that are running."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._followers: dict[str, Follower] = {}
        self._done: dict[str, float] = {}  # run id -> when the run that was shown had started

    @property
    def followed(self) -> list[str]:
        """The runs that are being shown."""
        return list(self._followers)

    def pieces(self) -> Iterator[bytes]:
        """One look at the store: what is new there.

        A run that cannot be shown is named once and does not stop the others.
        """
        for run_id in dict.fromkeys([*self._store.recent(DEAD_AFTER_S), *self._followers]):
            try:
                yield from self._follow(run_id)
            except Exception as error:
                _log.warning("cannot show %s in Rerun: %s", run_id, error)
                self._end(run_id, RunReader(self._store.path / run_id).status.started)

    def _follow(self, run_id: str) -> Iterator[bytes]:
        run = self._store.run(run_id)
        status = run.status  # before the rows: what comes later is not missed
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
