"""The description of a task in a run folder: enough to show the run without the task's code.

A run in one of our tasks needs none. Any other has the task's description in `config.json` and, in
MuJoCo, its geometry in `scene.npz`. Reading it imports nothing.
"""

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from tom.data.card import make_card
from tom.data.transitions import Transitions
from tom.envs import ENVS, ROAD, Task, scene, task
from tom.envs.termination import never
from tom.errors import UserError, reason
from tom.record import layout
from tom.record.reader import RunReader, Version


def description(env: str) -> dict[str, Any] | None:
    """The description of the task `env` for `config.json`; None for one of our tasks."""
    return None if env == ROAD else task(env).described()


def save_scene(env: str, folder: Path) -> None:
    """Write the geometry of a MuJoCo task that is not ours into a run folder."""
    if env == ROAD or task(env).described() is None:
        return
    model = scene.build_model(task(env))
    if model is not None:
        np.savez_compressed(folder / layout.SCENE, allow_pickle=False, **scene.arrays(model))


def changed(run: RunReader) -> tuple[str, str] | None:
    """A notice (code and text) if the run's task is no longer the one that it was recorded in.

    It names the fields of the two descriptions that differ; None if there are none.
    """
    recorded, now = run.config.get("task"), description(run.env)
    if not isinstance(recorded, dict) or now is None:
        return None
    differ = [
        f"{name} was {_shown(recorded[name])}, now {_shown(now[name])}"
        for name in now
        if name in recorded and not _is_same(recorded[name], now[name])
    ]
    if not differ:
        return None
    return "task", (
        f"the task {run.env} is not the one that run '{run.run_id}' was recorded in "
        f"({'; '.join(differ)}): numbers of both are mixed; put the task back, or start again"
    )


def card_of(run: RunReader) -> dict[str, Any]:
    """The card of the rows that a run collected, with its recorded notices; empty without rows."""
    rows, _ = run.buffer()
    if not len(rows):
        return {}
    notices = [{"code": row.get("code"), "text": row.get("message")} for row in run.notices()]
    return {**make_card(rows).described(), "notices": notices}


def _is_same(recorded: Any, now: Any) -> bool:
    try:
        numbers = np.asarray(recorded, np.float64), np.asarray(now, np.float64)
    except (TypeError, ValueError):
        return recorded == (list(now) if isinstance(now, tuple) else now)
    if not all(map(np.size, numbers)):
        return True  # a task that does not repeat itself has no rewards to compare
    if numbers[0].shape != numbers[1].shape:
        return False
    return np.allclose(*numbers, rtol=1e-3, atol=1e-6, equal_nan=True)  # NaN stands for None


def _shown(value: Any) -> str:
    if not isinstance(value, list | tuple):
        return str(value)
    texts = [f"{one:.4g}" if isinstance(one, float) else str(one) for one in value[:3]]
    return ", ".join(texts) + (", ..." if len(value) > 3 else "")


def task_of(run: RunReader) -> Task:
    """The run's task from its folder; a task that is not ours cannot be made into an environment.

    Raises UserError if the folder has no description.
    """
    if run.env in ENVS:
        return ENVS[run.env]
    described = run.config.get("task")
    if described is None:
        return task(run.env)
    try:
        return Task(
            name=run.env,
            terminated=never,
            knows_ends=False,
            steps=1,
            action_dim=int(described["action_dim"]),
            obs_names=tuple(described["obs_names"]),
            max_episode_steps=int(described["max_episode_steps"]),
            nq=described.get("nq", 0),
            root_dims=described.get("root_dims"),
        )
    except (LookupError, TypeError, ValueError, AttributeError) as error:
        raise UserError(
            f"run '{run.run_id}' does not say what its task {run.env} is: {layout.CONFIG} has no "
            f"valid 'task' ({reason(error)})"
        ) from None


def dimension_names(
    env: str, rows: Transitions, described: Sequence[str]
) -> tuple[list[str], list[str]]:
    """The names of the observation's and the action's dimensions, (O,) and (A,).

    `described` are the observation's names in the run's task; none on road-and-rocks.
    """
    o, a = np.shape(rows.obs)[1], np.shape(rows.action)[1]
    named = ("x", "y") if env == ROAD else described
    names = list(named) if len(named) == o else [f"observation {i + 1}" for i in range(o)]
    actions = ENVS[env].action_names if env in ENVS else ()
    return names, list(actions) or [f"action {i + 1}" for i in range(a)]


def seconds(run: RunReader) -> float:
    """The duration in seconds of a step of the run's task on the screen."""
    if run.env in ENVS:
        return scene.model(run.env).dt
    return (run.config.get("task") or {}).get("dt", 1 / 30)


def scene_of(run: RunReader) -> scene.Model | None:
    """The model to draw the run's robot; None for a task that is unknown or without MuJoCo."""
    if run.env in ENVS:
        return scene.model(run.env)
    path = run.path / layout.SCENE
    return _scene(run.path, run.version("scene")) if path.is_file() else None


@lru_cache(maxsize=16)
def _scene(path: Path, version: Version) -> scene.Model | None:
    """The model in the run folder `path`, cached until its file has another `version`."""
    arrays = RunReader(path).arrays(layout.SCENE)
    try:
        return None if arrays is None else scene.of_arrays(arrays)
    except (ValueError, KeyError, TypeError, IndexError):
        return None
