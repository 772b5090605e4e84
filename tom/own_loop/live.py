"""`tom.weigh_live`: learners' weights of a growing buffer, in a process of its own.

    python -m tom.own_loop.live RUN BEGAN_AT EVERY LEARNER...

It reads the run folder and never touches the training. Each learner's weights are a run folder
without rows, `RUN/live/LEARNER`, with a lock of its own: `RunReader.live` reads it with the rows of
the run.
"""

import os
import signal
import sys
import time
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from tom import plugins
from tom.config import ModelConfig, OwnLoopConfig
from tom.data.datasets import initial_obs
from tom.data.transitions import Transitions
from tom.data.unpack import read_arrays
from tom.envs import import_task
from tom.errors import TryLaterError, UserError, check_known, reason
from tom.events import Event, Metrics, Notice, Tick
from tom.exams.diagnostics import ending_metrics, weight_metrics
from tom.exams.exam import Exam, Fitted, footprint_metrics
from tom.learners import LEARNERS, follows_value, make_learner, with_own_settings
from tom.learners.base import FitContext
from tom.machine.processes import Process, on_stopping, start
from tom.own_loop.opening import open_record
from tom.own_loop.run import OwnRun
from tom.policy.stored import StoredPolicy
from tom.record import RunReader, Store, layout, lock
from tom.rng import Streams
from tom.training import presets

LIVE = "live"
"""in place of a preset: nothing was trained with these weights"""
POLL_S = 0.5
WAIT_S = 600.0
NICE = 19
POLICY_ROWS = 1000
"""the newest rows, which stand for the policy"""
NO_CRITICS = (
    "no-critics",
    "this learner follows a value function, and the kept policy comes without one: every row "
    "counts the same",
)


class LiveWeighing:
    """The process that weighs a run's buffer; it ends by itself when the run does."""

    def __init__(self, process: Process, log: Path) -> None:
        self._process, self._log = process, log

    def failed(self) -> str:
        """Why it failed; empty as long as it has not."""
        if not self._process.poll():
            return ""
        lines = self._log.read_text().strip().splitlines() or ["no reason given"]
        return f"{lines[-1]} (all of it: {self._log})"

    def wait(self, timeout: float | None = None) -> None:
        """Wait for its end, after the run's. Raises UserError if it failed."""
        self._process.wait(timeout)
        if why := self.failed():
            raise UserError(f"the live weighing failed: {why}")


def weigh_live(
    run: OwnRun, learners: Sequence[str] = ("tom", "pmac"), every: int = 5000
) -> LiveWeighing:
    """Weigh the newest buffer by the newest policy of `run.policy` every `every` rows.

    At the lowest priority, in a process of its own. If it falls behind it skips, with a notice.
    Raises UserError for an unknown learner, or one that needs what no loop hands in.
    """
    check_known("learner", learners, LEARNERS)
    for name in learners:
        entry = LEARNERS[name]
        if entry.follows_behaviour or entry.follows_model:
            needs = "each row's policy" if entry.follows_behaviour else "a model's errors"
            raise UserError(f"learner {name} needs {needs}, which no loop hands in: leave it out")
    if every < 1:
        raise UserError(f"every {every}: weigh every so many rows, at least 1")
    log = run.path / layout.LIVE / "log.txt"
    log.parent.mkdir(exist_ok=True)
    command = [sys.executable, "-m", "tom.own_loop.live", str(run.path)]
    command += [str(run.began_at), str(every), *learners]
    with log.open("wb") as out:
        process = start(command, out, {**os.environ, "OMP_NUM_THREADS": "1"}, outlives=True)
    live = LiveWeighing(process, log)
    run.live.append(live.failed)
    return live


class _LearnerRecord:
    """One learner's weights of the run `source`: its record, and what it keeps between fits."""

    def __init__(self, source: RunReader, learner: str, every: int, began_at: int) -> None:
        own = with_own_settings(OwnLoopConfig, [learner])
        usual = presets.resolve(source.env, learner).model_dump()
        settings = {name: value for name, value in usual.items() if name in own.model_fields}
        settings |= {"seed": source.seed, "preset": LIVE, "every": every}
        settings |= {"steps": source.config["config"]["steps"]}
        self.config = own.model_validate(settings)
        until, place = time.monotonic() + WAIT_S, Store(source.path / layout.LIVE)
        while True:  # the process of a loop that was killed may still weigh its last buffer
            try:
                self.recorder = open_record(place, learner, self.config, "auto", began_at)
                break
            except TryLaterError:
                if time.monotonic() > until:
                    raise
                time.sleep(POLL_S)
        self.streams = Streams(source.seed)
        self._fitted: Fitted | None = None
        self._learner: Any = None

    def weigh(self, rows: Transitions, version: NDArray, policy: dict[str, Any]) -> None:
        """Record the exam of the last fit, and the weights of rows (N,) of these versions (N,)."""
        replay, n, step = rows.torch(), len(rows), int(version.max())
        if self._fitted is not None and n > len(self._fitted.weights):
            exam = Exam.of(self._fitted, replay, n - len(self._fitted.weights))
            metrics = footprint_metrics(exam, self.streams.torch("exam"))
            self.recorder.consume(Metrics(self._fitted.env_step, metrics))
        stored = StoredPolicy(policy)
        if self._learner is None:
            dims = replay.obs.shape[1], replay.action.shape[1]
            generator = self.streams.torch("learner")
            self._learner = make_learner(self.config.learner, self.config, *dims, generator)
        newest = torch.from_numpy(np.sort(np.argsort(version)[-POLICY_ROWS:]))
        context = FitContext(
            replay=replay,
            policy_version=torch.from_numpy(version),
            policy_buffer=replay[newest],
            on_policy_steps=n,
            initial_obs=torch.as_tensor(initial_obs(rows)),
            policy=stored,
            generator=self.streams.torch("weigh"),
            value_gradient=stored.value_gradient,
        )
        weighting = self._learner.weigh(context)
        self._fitted = Fitted(step, weighting.counted(ModelConfig()))
        shape = weight_metrics(weighting.weights)
        shape |= ending_metrics(replay, context.policy_buffer, weighting.weights)
        events: list[Event] = [weighting.event(step, policy, rows=n)]
        events.append(Metrics(step, {**weighting.metrics, **shape, "buffer/size": float(n)}))
        events += [Notice(step, code, text) for code, text in weighting.notices]
        if stored.value_gradient is None and follows_value(self.config.learner):
            events.append(Notice(step, *NO_CRITICS))
        for event in (*events, Tick(step, "weigh")):
            self.recorder.consume(event)


def follow(source: RunReader, learners: Sequence[str], every: int, began_at: int) -> None:
    """Weigh the buffer of the run `source` until the run ends, and once more then.

    Weights of rows handed in after step `began_at` are of a loop that was cut back, and go.
    """
    writer = source.status.pid
    with ExitStack() as stack:
        lives = [_LearnerRecord(source, learner, every, began_at) for learner in learners]
        for live in lives:
            stack.enter_context(live.recorder)
        last, took = 0, 0.0
        while True:
            # The lock first: it goes after the last status, which the run may write meanwhile.
            held, source = lock.is_held(source.path), RunReader(source.path)
            now = source.status  # of another process: the loop was started again
            running = now.state == "running" and now.pid == writer and held
            rows, steps = source.buffer_length(), source.policy_steps()
            due = rows - last >= every if running else rows > last
            if due and steps:
                recorded = source.buffer()
                # Of several environments many rows come at once, however slow their loop is.
                meanwhile = int(took * (now.env_steps_per_s or 0))
                skipped = min(rows - last, meanwhile) // every - 1
                if skipped > 0:
                    text = (
                        f"{skipped} weighings were skipped: one takes {took:.0f} s here, in which "
                        f"the loop takes more than {every} steps; weigh less often"
                    )
                    for live in lives:
                        live.recorder.consume(Notice(int(recorded[1].max()), "behind", text))
                started_at = time.monotonic()
                policy = read_arrays(source.path / layout.policy(steps[-1]))
                last = len(recorded[0])
                for live in lives:
                    live.weigh(*recorded, policy)
                took = time.monotonic() - started_at
            if not running:
                if now.state != "finished":
                    for live in lives:
                        live.recorder.finish("stopped", f"run {source.run_id} ended unfinished")
                return
            time.sleep(POLL_S)


def main(run: str, began_at: str, every: str, *learners: str) -> int:
    """Run the process; returns its exit code."""
    with suppress(OSError):
        os.nice(NICE)
    torch.set_num_threads(1)
    try:
        plugins.load([])
        source = RunReader(run)
        import_task(source.env)
        with on_stopping(signal.default_int_handler):
            follow(source, learners, int(every), int(began_at))
    except (UserError, OSError, KeyboardInterrupt) as error:
        print(reason(error), file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
