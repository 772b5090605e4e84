"""Trainings of seconds for the fault tests, in this process or in one that may be killed."""

import os
import subprocess
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import torch
from common import stopping_at
from kernel import wait_for

from tom.config import OnlineConfig
from tom.events import Event, Tick
from tom.record import RunReader, Store
from tom.training.presets import resolve
from tom.training.resume import resume
from tom.training.run import train

SETTINGS = {
    "steps": 240,
    "exploration_steps": 40,
    "fit_every": 40,
    "checkpoint_every": 20,
    "matmul": "default",
    "rollout": {"starts": 200},
    "evaluation": {"every": 80, "episodes": 1},
    "tom": {"warmup": 30},
}


def config(learner: str = "mle", env: str = "inverted-pendulum", **changes: object) -> OnlineConfig:
    """A training of about a second."""
    made = resolve(env, learner, "smoke", {**SETTINGS, **changes})
    assert isinstance(made, OnlineConfig)
    return made


def stopped(store: Store, step: int, run_id: str = "a", **changes: object) -> RunReader:
    """A run that was stopped after `step`."""
    stop, watchers = stopping_at(step)
    made = config(**changes)  # pyright: ignore[reportArgumentType]
    return train(made, store, run_id, rerun=False, watchers=watchers, stop=stop)


# Processes of their own


def tom(*arguments: object, **how: object) -> subprocess.Popen[str]:
    """`tom ...` in a process, its output in pipes."""
    return subprocess.Popen(
        [sys.executable, "-m", "tom", *map(str, arguments)],
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        **how,  # pyright: ignore[reportArgumentType, reportCallIssue]
    )


def train_command(store: Path, learner: str = "mle", **changes: object) -> list[object]:
    """The command line of `config`'s training."""
    given: dict[str, object] = {}
    for name, value in {**SETTINGS, **changes}.items():
        parts = value.items() if isinstance(value, dict) else [("", value)]
        given |= {f"{name}.{inner}" if inner else name: number for inner, number in parts}
    options = [f"--{name.replace('_', '-')}={value}" for name, value in given.items()]
    which = ["--env", "inverted-pendulum", "--learner", learner, "--preset", "smoke"]
    return ["train", *which, "--store", store, "--no-rerun", *options]


def ended(process: subprocess.Popen[str], timeout_s: float = 240) -> tuple[int, str, str]:
    """Its exit code, output and errors."""
    out, error = process.communicate(timeout=timeout_s)
    return process.returncode, out, error


wait_until = partial(wait_for, seconds=150)


def go_on(path: Path, run_id: str, steps: int, rerun: bool) -> None:
    """Train or resume, writing each step that is whole into `path`/step; to be killed."""
    torch.set_num_threads(1)
    store = Store(path)
    with (path / "step").open("r+b", buffering=0) as done:

        def watch(event: Event) -> None:
            if isinstance(event, Tick) and event.ends_step:
                os.pwrite(done.fileno(), b"%09d" % event.env_step, 0)

        if (path / run_id).exists():
            resume(store, run_id, steps, rerun=rerun, watchers=(watch,))
        else:
            train(config("tom", steps=steps), store, run_id, rerun=rerun, watchers=(watch,))


def one_line(error: str) -> str:
    """The one line that a command printed as its error."""
    lines: Sequence[str] = error.strip().splitlines()
    assert len(lines) == 1, error
    return lines[0]
