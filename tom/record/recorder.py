"""Records a training's events in a run folder and a live view, in under 2 % of its time."""

import logging
import os
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import replace
from math import isfinite
from types import TracebackType
from typing import Any, Literal, Self

import numpy as np

from tom.config import OwnLoopConfig
from tom.errors import DISK_FULL, DivergedError, OwnCodeError
from tom.events import (
    Collected,
    Evaluation,
    Event,
    Field,
    KeptPolicy,
    Metrics,
    Notice,
    Tick,
    TrainedPolicy,
    Weights,
)
from tom.machine.memory import is_out_of_memory, out_of_memory
from tom.record import checkpoint, decode, layout
from tom.record.lock import LostError
from tom.record.reader import RunReader
from tom.record.rerun.sink import RerunSink
from tom.record.status import BEAT_S, Status
from tom.record.writer import RunWriter

State = Literal["finished", "stopped", "failed"]

WARNINGS = 8
"""kinds of notices that appear as warnings in the status"""
WINDOW_S = 120.0
"""seconds over which speed and remaining time are estimated"""

_log = logging.getLogger(__name__)


class Recorder:
    """Consumes the events of one training and records them.

    A thread writes the status every BEAT_S seconds, also during a model fit of minutes. As a
    context manager it sets the final status: `stopped` after Ctrl-C, `failed` with the reason after
    any other exception, else `finished`. `clock` gives unix seconds, `timer` monotonic seconds.
    """

    def __init__(
        self,
        writer: RunWriter,
        sink: RerunSink | None = None,
        clock: Callable[[], float] = time.time,
        timer: Callable[[], float] = time.monotonic,
        mark: Mapping[str, Any] | None = None,
    ) -> None:
        """`mark` is the result of `Recorder.mark` at the checkpoint from which the run resumes."""
        resumed: Mapping[str, Any] = mark or {}
        config, step = writer.config, resumed.get("env_step", 0)
        self.writer = writer
        self.run_id = writer.run_id
        self._config = config
        self._sink = sink
        self._clock, self._timer = clock, timer
        self._started = timer() - resumed.get("wall_s", 0.0)
        self._last_row = (timer(), step)
        self._timed = resumed.get("timed", -1)  # the step of the last row with times
        self._pending: dict[str, float] = {}
        self._pending_step = 0
        self._record_s = resumed.get("record_s", 0.0)
        self._checkpoint_s = resumed.get("checkpoint_s", 0.0)
        self._next_snapshot = resumed.get("next_snapshot", 0.0 if config.snapshots else np.inf)
        self._finished = False
        last, best = resumed.get("returns", (None, None))
        self._best: float | None = best  # of the rows that are written
        self.status = Status(
            state="running",
            phase="start",
            env_step=step,
            total=config.total_steps,
            started=clock(),
            pid=os.getpid(),
            last_return=last,
            best_return=best,
        )
        self._status_lock = threading.Lock()
        self._warnings: dict[str, str] = {}  # by kind, the newest last
        self._speeds: deque[tuple[float, int]] = deque([(timer(), step)])
        self._ending = threading.Event()
        self.beat()
        self._heart = threading.Thread(target=self._beat_on, name="heartbeat", daemon=True)
        self._heart.start()
        if mark:
            try:
                writer.rewind(mark["files"])
                for notice in RunReader(writer.path).notices():  # their warnings count again
                    at, code, message = map(notice.get, ("env_step", "code", "message"))
                    self._warn(str(code), at, str(message))
            except BaseException as error:
                self.__exit__(type(error), error, error.__traceback__)
                raise
        if sink:
            sink.start(step if mark else -1)

    def mark(self) -> dict[str, Any]:
        """The position of the synced record; part of a checkpoint, taken right after a `Tick`."""
        return {
            "env_step": self.status.env_step,
            "wall_s": self._timer() - self._started,
            "record_s": self._record_s,
            "checkpoint_s": self._checkpoint_s,
            "timed": self._timed,
            "next_snapshot": self._next_snapshot,
            "returns": (self.status.last_return, self.status.best_return),
            "files": self.writer.mark(),
        }

    def save(self, state: Mapping[str, Any]) -> None:
        """Write a checkpoint of the training's `state`, right after a `Tick`.

        If it does not fit the disk, the last one stays and a notice says so. Raises LostError if
        another writer has taken the run over.
        """
        started, folder = time.perf_counter(), self.writer.path / checkpoint.FOLDER
        step = self.status.env_step
        config = self._config.model_dump(mode="json")
        try:
            checkpoint.save(folder, step, {**state, "record": self.mark(), "config": config})
        except LostError:
            raise
        except OSError as error:
            message = f"no checkpoint could be written ({error}): free some space"
            self.consume(Notice(step, "checkpoint", message))
        self._checkpoint_s += time.perf_counter() - started

    def consume(self, event: Event) -> None:
        started = time.perf_counter()
        if event.env_step != self._pending_step or isinstance(event, Tick):
            self._write_row()
        match event:
            case Tick():
                if event.phase != self.status.phase and self.status.phase == "explore":
                    # Exploration is much faster than training: it does not predict the time left.
                    with self._status_lock:
                        self._speeds = deque([(self._timer(), event.env_step)])
                self._update_status(env_step=event.env_step, phase=event.phase)
            case Metrics():
                self._merge(event.env_step, event.values)
            case Weights():
                self._weights(event)
            case Evaluation():
                self._evaluation(event)
            case Collected():
                self.writer.rows(event)
            case Field():
                self.writer.arrays(layout.field(event.name, event.env_step), event.arrays)
            case Notice():
                self._warn(event.kind, event.env_step, event.message)
                self.writer.notice(event.env_step, event.kind, event.message)
            case KeptPolicy():
                self.writer.arrays(layout.policy(event.env_step), event.arrays)
            case TrainedPolicy():
                self.writer.arrays(layout.POLICY, event.arrays)
        self._record_s += time.perf_counter() - started

    def beat(self) -> None:
        """Write the status with a fresh heartbeat, and the speed and time left by WINDOW_S."""
        with self._status_lock:
            now, step = self._timer(), self.status.env_step
            while len(self._speeds) > 1 and now - self._speeds[0][0] > WINDOW_S:
                self._speeds.popleft()
            then, step_then = self._speeds[0]
            self._speeds.append((now, step))
            rate = (step - step_then) / (now - then) if now > then else None
            left = max(self.status.total - step, 0)
            self.status = replace(
                self.status,
                heartbeat=self._clock(),
                env_steps_per_s=rate,
                eta_s=left / rate if rate else None,
            )
            self.writer.status(self.status)

    def finish(self, state: State, reason: str = "") -> None:
        """End the run: write the final status and the Parquet copy of the metrics, close all files.

        If the disk is full, a finished run becomes a failed one; an earlier reason is kept.
        """
        if self._finished:
            return
        self._finished = True
        self._ending.set()
        self._heart.join()
        try:
            self._write_row()
            if lost := self._sink.close() if self._sink else None:
                self.writer.notice(self.status.env_step, "rerun", lost)
            self.writer.metrics_table()
            if state == "finished":
                self.writer.digests()
        except OSError as error:
            if state == "finished":
                state, reason = "failed", self._failure_reason(error)
        finally:
            seconds = self._timer() - self._started
            self._update_status(
                state=state,
                reason=reason,
                phase="",
                heartbeat=self._clock(),
                eta_s=None,
                env_steps_per_s=self.status.env_step / seconds if seconds > 0 else None,
            )
            try:
                self.writer.status(self.status)
            except OSError as error:  # not even the status fits: readers will show the run as dead
                _log.error("%s %s (%s), and no status can be written", self.run_id, state, error)
            self.writer.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if error is None:
            self.finish("finished")
        elif isinstance(error, KeyboardInterrupt):
            self.finish("stopped", "interrupted")
        else:
            self.finish("failed", self._failure_reason(error))

    def _failure_reason(self, error: BaseException) -> str:
        """The cause of the run's end, the step, and the fix."""
        if isinstance(error, DivergedError):
            return str(error)
        why = f"{type(error).__name__}: {error}"
        if isinstance(error, OwnCodeError):
            why = str(error)
        elif isinstance(error, OSError) and error.errno in DISK_FULL:
            own = isinstance(self._config, OwnLoopConfig)
            again = 'start it with resume="auto"' if own else f"tom train --resume {self.run_id}"
            why = f"{error}: free some space, then {again}"
        elif is_out_of_memory(error):
            why = out_of_memory(error)
        return f"step {self.status.env_step}: {why}"

    # The status

    def _update_status(self, **changes: Any) -> None:
        with self._status_lock:
            self.status = replace(self.status, **changes)

    def _warn(self, kind: str, step: object, message: str) -> None:
        """Add a warning for readers of the run; it replaces the last one of its kind."""
        self._warnings.pop(kind, None)
        self._warnings[kind] = f"step {step}: {message}"
        self._update_status(warnings=tuple(self._warnings.values())[-WARNINGS:])

    def _beat_on(self) -> None:
        while not self._ending.wait(BEAT_S):
            try:
                self.beat()
            except OSError:  # the disk is full: the run looks dead until there is room again
                continue

    # The files

    def _merge(self, env_step: int, values: Mapping[str, float]) -> None:
        self._pending_step = env_step
        self._pending.update(values)
        if isfinite(returned := values.get("eval/return", np.nan)):
            best = returned if self._best is None else max(self._best, returned)
            self._update_status(last_return=returned, best_return=best)
            self._pending["eval/return_max"] = best

    def _write_row(self) -> None:
        """Write the metrics of the step that is over."""
        if not self._pending:
            return
        step, values, self._pending = self._pending_step, self._pending, {}
        self._best = self.status.best_return
        # Metrics of an earlier step (a fit's exam) have no time of their own, and of a step with
        # two rows the first counts: an evaluation is not as late as the fit that follows.
        if step >= self.status.env_step and step != self._timed:
            now, self._timed = self._timer(), step
            then, step_then = self._last_row
            values |= {
                "time/wall_s": now - self._started,
                "time/record_s": self._record_s,
                "time/checkpoint_s": self._checkpoint_s,
            }
            if now > then and step > step_then:
                values["time/env_steps_per_s"] = (step - step_then) / (now - then)
                self._last_row = (now, step)
        self.writer.append(layout.METRICS, {"env_step": step, **values})

    def _weights(self, weights: Weights) -> None:
        step, parts, total = weights.env_step, self._config.snapshots, self._config.total_steps
        self.writer.profile(weights, self._config.bins)
        chosen = step >= self._next_snapshot
        if chosen:  # next, the first step of the next of `snapshots` equal parts of the run
            self._next_snapshot = -(-(step * parts // total + 1) * total // parts)
        self.writer.snapshot(weights, keep=chosen)

    def _evaluation(self, evaluation: Evaluation) -> None:
        step, episodes = evaluation.env_step, evaluation.episodes
        self.writer.arrays(layout.episodes(step), decode.episode_arrays(episodes))
        if not episodes:
            return
        returns = np.array([episode.undiscounted_return for episode in episodes])
        values = {
            "eval/return": float(returns.mean()),
            "eval/return_std": float(returns.std()),
            "eval/length": float(np.mean([episode.length for episode in episodes])),
        }
        success = [episode.info["success"] for episode in episodes if "success" in episode.info]
        if success:
            values["eval/success"] = float(np.mean(success))
        self._merge(step, values)
