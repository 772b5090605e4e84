"""Turns run folders into live Rerun recordings: one a viewer, or all of them for a hub.

It reads as any reader does: trainings know nothing of it, and it may start late. A hub that dies
and comes back is fed again from the beginning.
"""

import logging
import os
import socket
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr

from tom.envs import ENVS
from tom.events import Evaluation, Field
from tom.machine.address import in_url
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

    def __init__(self, run: RunReader, sink: rr.FileSink | rr.GrpcSink | None = None) -> None:
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
    """The bytes of a recording that grows with the run and ends with it."""
    follower = Follower(run)
    while not stopping.is_set():
        alive = run.status.alive  # before the rows: what comes later is not missed
        yield from follower.pieces()
        if not alive:
            return
        stopping.wait(POLL_S)


class Feeder:
    """Feeds the hub at `host`:`port` with the runs of `store` that are running."""

    def __init__(self, store: Store, host: str, port: int) -> None:
        self._store = store
        self._address = (host, port)
        self._followers: dict[str, Follower] = {}
        self._done: dict[str, float] = {}  # run id -> when the run that was shown had started

    @property
    def followed(self) -> list[str]:
        """The runs that are being shown."""
        return list(self._followers)

    def run(self, stopping: threading.Event) -> None:
        """Feed until `stopping`."""
        while not stopping.wait(POLL_S):
            if self.hub_answers():
                self.poll()
            else:
                self._forget()

    def poll(self) -> None:
        """One look at the store."""
        for run_id in self._store.recent(DEAD_AFTER_S):
            self._guarded(run_id, self._start)
        for run_id in list(self._followers):
            self._guarded(run_id, self._follow)

    def _start(self, run_id: str) -> None:
        if run_id in self._followers:
            return
        run = self._store.run(run_id)
        if self._done.get(run_id) != run.status.started:
            host, port = self._address
            sink = rr.GrpcSink(f"rerun+http://{in_url(host)}:{port}/proxy")
            self._followers[run_id] = Follower(run, sink)

    def _follow(self, run_id: str) -> None:
        follower = self._followers[run_id]
        status = follower.run.status  # before the rows: what comes later is not missed
        for _ in follower.follow():
            pass  # Rerun waits with what the hub does not take
        if not status.alive:
            self._done[run_id] = status.started
            self._followers.pop(run_id).close()

    def _guarded(self, run_id: str, step: Callable[[str], None]) -> None:
        """A run that cannot be shown is named once and does not stop the others."""
        try:
            step(run_id)
        except Exception as error:
            _log.warning("cannot show %s in Rerun: %s", run_id, error)
            self._followers.pop(run_id, None)
            self._done[run_id] = RunReader(self._store.path / run_id).status.started

    def hub_answers(self) -> bool:
        """The hub is there."""
        # Rerun itself would wait 5 s for a hub that is not there.
        try:
            with socket.create_connection(self._address, timeout=1):
                return True
        except OSError:
            return False

    def _forget(self) -> None:
        self._followers.clear()
        self._done.clear()
