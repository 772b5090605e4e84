"""Any Gymnasium task with Box spaces: `gymnasium:Swimmer-v5`, `my_package:MyTask-v0`.

The module before the colon registers the task when it is imported, as in `gymnasium.make`. It is
code that the user chose: only `describe` imports it, never a reader of runs.
"""

from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium.wrappers import TimeLimit
from numpy.typing import NDArray
from torch import Tensor

from tom.envs import dm_control, termination
from tom.envs.environment import Unit, simulated
from tom.envs.inspection import (
    actions_of,
    bounded_dims,
    box_of,
    obs_names_of,
    root_dims_of,
    seconds_of,
    take_a_step,
)
from tom.envs.mujoco import log_warnings
from tom.envs.task import Task, Termination
from tom.envs.user_code import import_named, tried
from tom.errors import OF_USERS, UserError, reason

OWN = "gymnasium"
"""the module of Gymnasium's own tasks, which is always imported"""
STEPS = 100_000
"""default number of env steps in an unknown task"""
TIME_LIMIT = 1000
"""length of an episode if the task's specification sets no limit"""

Floats = tuple[float, ...]


@dataclass(frozen=True, kw_only=True)
class GymnasiumTask(Task):
    """A task given by its Gymnasium id, rescaled by its bounds.

    An observation is `(obs - obs_offset) / obs_scale`; actions of -1 and 1 are the bounds; a step
    takes `dt` seconds on the screen.
    """

    gym_id: str
    action_low: Floats
    action_high: Floats
    obs_offset: Floats
    obs_scale: Floats
    dt: float

    def make(self, seed: int | None = None) -> gym.Env[np.ndarray, np.ndarray]:
        action = np.array(self.action_low), np.array(self.action_high)
        obs = np.array(self.obs_offset), np.array(self.obs_scale)
        limited = _limited(_made(self.gym_id, self.name), self.max_episode_steps)
        env = Unit(limited, action, obs, self.name)
        if seed is not None:
            env.reset(seed=seed)
        return env

    def described(self) -> dict[str, Any]:
        names = "gym_id", "action_low", "action_high", "obs_offset", "obs_scale", "dt"
        names += "action_dim", "obs_names", "max_episode_steps", "nq", "root_dims", "knows_ends"
        return {name: getattr(self, name) for name in names}

    def own_obs(self, obs: NDArray) -> NDArray[np.float64]:
        """Observations (..., O) in the task's own units."""
        return np.asarray(obs, np.float64) * np.array(self.obs_scale) + np.array(self.obs_offset)

    def unit_obs(self, obs: NDArray) -> NDArray[np.float32]:
        """Observations (..., O) in the task's own units, rescaled as agents see them."""
        centred = np.asarray(obs, np.float64) - np.array(self.obs_offset)
        return (centred / np.array(self.obs_scale)).astype(np.float32)


def describe(name: str) -> GymnasiumTask:
    """The task `module:Id`: imports the module and makes the task once to inspect it.

    Raises UserError if there is no such task, or if it cannot be trained in.
    """
    module, _, gym_id = name.partition(":")
    if not gym_id or ":" in gym_id:
        raise UserError(f"task '{name}': write MODULE:ID, such as gymnasium:Swimmer-v5")
    if dm_control.is_one(gym_id):
        dm_control.without_screen()
    if module != OWN:
        import_named(module, f"--env {name}")
    return look_at(name, gym_id)


def look_at(name: str, gym_id: str, terminated: Termination | None = None) -> GymnasiumTask:
    """The task of that Gymnasium id, made once to inspect it; `terminated` is its own rule.

    Raises UserError if there is no such task, or if it cannot be trained in.
    """
    env = _made(gym_id, name)
    try:
        known = _described(name, gym_id, env)
    finally:
        with suppress(*OF_USERS):  # whatever its close does, it was made to be looked at
            env.close()
    if terminated is None:
        return known
    own = tried(in_own_units(terminated, known), known, f"of {name}")
    return replace(known, terminated=own, knows_ends=True)


def in_own_units(given: Termination, known: GymnasiumTask) -> Termination:
    """`given` for rescaled observations, which it gets in the task's own units."""
    scale, offset = torch.tensor(known.obs_scale), torch.tensor(known.obs_offset)
    if bool((scale == 1).all() and (offset == 0).all()):
        return given

    def terminated(next_obs: Tensor) -> Tensor:
        return given(next_obs * scale.to(next_obs) + offset.to(next_obs))

    return terminated


def _made(gym_id: str, name: str) -> gym.Env:
    log_warnings()
    try:
        made = gym.make(gym_id, disable_env_checker=True)
    except OF_USERS as error:  # Gymnasium's errors as well
        advice = dm_control.advice(error) if dm_control.is_one(gym_id) else ""
        raise UserError(f"task '{name}' cannot be made: {reason(error)}{advice}") from error
    return dm_control.flat(made) if dm_control.is_one(gym_id) else made


def _limited(env: gym.Env, steps: int) -> gym.Env:
    """`env` with a time limit, unless its specification has set one already."""
    limited = env.spec is not None and env.spec.max_episode_steps is not None
    return env if limited else TimeLimit(env, steps)


def _described(name: str, gym_id: str, env: gym.Env) -> GymnasiumTask:
    obs = box_of(getattr(env, "observation_space", None), name, "observes")
    action = actions_of(getattr(env, "action_space", None), name)
    take_a_step(name, env, obs, action)
    bounded = bounded_dims(obs)
    low, high = np.where(bounded, obs.low, -1.0), np.where(bounded, obs.high, 1.0)
    simulator = simulated(env)
    root_dims = None if simulator is None else root_dims_of(env, simulator, name)
    seen_as_they_are = root_dims if not bounded.any() else None  # joints, in their own units
    limit = None if env.spec is None else env.spec.max_episode_steps
    return GymnasiumTask(
        name=name,
        gym_id=gym_id,
        terminated=termination.never,
        knows_ends=False,
        steps=STEPS,
        action_dim=len(action.low),
        obs_names=(dm_control.obs_names(env) if dm_control.is_one(gym_id) else None)
        or obs_names_of(len(obs.low), simulator, root_dims),
        max_episode_steps=limit or TIME_LIMIT,
        nq=0 if simulator is None else int(simulator.model.nq),
        root_dims=seen_as_they_are,
        keeps_states=simulator is not None and seen_as_they_are is None,
        action_low=_floats(action.low),
        action_high=_floats(action.high),
        obs_offset=_floats(0.5 * (high + low)),
        obs_scale=_floats(0.5 * (high - low)),
        dt=seconds_of(env),
    )


def _floats(array: NDArray) -> Floats:
    return tuple(float(value) for value in array)
