"""The description of a task in a run folder: enough to show the run without the task's code.

A run in one of our tasks needs none. Any other has the task's description in `config.json` and, in
MuJoCo, its geometry in `scene.npz`. Reading it imports nothing.
"""

from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import ConfigDict, Field, ValidationError

from tom.config import Config, Count, Positive, Whole
from tom.envs import ENVS, ROAD, Task, scene, skeleton, task
from tom.envs.termination import never
from tom.errors import UserError
from tom.record import layout
from tom.record.reader import RunReader, Version

MOST_DIMS = 100_000


class _Described(Config):
    """The part of a description that readers need."""

    model_config = ConfigDict(extra="ignore")

    obs_names: Annotated[tuple[str, ...], Field(min_length=1, max_length=MOST_DIMS)]
    action_dim: Annotated[int, Field(ge=1, le=MOST_DIMS)]
    max_episode_steps: Count
    nq: Whole = 0
    root_dims: Whole | None = None
    dt: Positive


def description(env: str) -> dict[str, Any] | None:
    """The description of the task `env` for `config.json`; None for one of our tasks."""
    return None if env == ROAD else task(env).described()


def save_scene(env: str, folder: Path) -> None:
    """Write the geometry of a MuJoCo task that is not ours into a run folder."""
    if env == ROAD or task(env).described() is None:
        return
    model = scene.made_model(task(env))
    if model is not None:
        np.savez_compressed(folder / layout.SCENE, allow_pickle=False, **skeleton.arrays(model))


def task_of(run: RunReader) -> Task:
    """The run's task from its folder; a task that is not ours cannot be made into an environment.

    Raises UserError if the folder has no description.
    """
    if run.env in ENVS:
        return ENVS[run.env]
    said = _described(run)
    if said is None:
        return task(run.env)
    return Task(
        name=run.env,
        terminated=never,
        knows_ends=False,
        steps=1,
        action_dim=said.action_dim,
        obs_names=said.obs_names,
        max_episode_steps=said.max_episode_steps,
        nq=said.nq,
        root_dims=said.root_dims,
    )


def seconds(run: RunReader) -> float:
    """The duration in seconds of a step of the run's task on the screen."""
    if run.env in ENVS:
        return scene.model(run.env).dt
    said = _described(run)
    return 1 / 30 if said is None else said.dt


def scene_of(run: RunReader) -> scene.Model | None:
    """The model to draw the run's robot; None for a task that is unknown or without MuJoCo."""
    if run.env in ENVS:
        return scene.model(run.env)
    path = run.path / layout.SCENE
    return _scene(run.path, run.version("scene")) if path.is_file() else None


@lru_cache(maxsize=16)
def _scene(path: Path, version: Version) -> scene.Model | None:
    held = RunReader(path).arrays(layout.SCENE)
    try:
        return None if held is None else skeleton.of_arrays(held)
    except (ValueError, KeyError, TypeError, IndexError):
        return None


def _described(run: RunReader) -> _Described | None:
    content = run.config.get("task")
    try:
        return None if content is None else _Described.model_validate(content)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        field = ".".join(map(str, ("task", *first["loc"])))
        raise UserError(
            f"run '{run.run_id}' does not say what its task {run.env} is: {field} of its "
            f"{layout.CONFIG}: {first['msg']}"
        ) from None
