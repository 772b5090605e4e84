"""Any Gymnasium task with Box spaces: `gymnasium:Swimmer-v5`, `my_package:MyTask-v0`.

The module before the colon registers the task when it is imported, as in `gymnasium.make`. It is
code that the user chose: only `describe` imports it, never a reader of runs.
"""

import importlib
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium.spaces import Box
from gymnasium.wrappers import TimeLimit
from numpy.typing import NDArray
from torch import Tensor

from tom.envs import dm_control, termination
from tom.envs.mujoco import log_warnings
from tom.envs.simulator import Simulator, simulated
from tom.envs.task import Task, Termination
from tom.envs.unit import Unit
from tom.errors import OF_USERS, UserError, reason

OWN = "gymnasium"
"""the module of Gymnasium's own tasks, which is always imported"""
STEPS = 100_000
"""default number of env steps in an unknown task"""
TIME_LIMIT = 1000
"""length of an episode if the task's specification sets no limit"""
UNBOUNDED = 1e6
"""larger bounds are taken as no bound"""
LOOKED_AT = 20
"""steps that test whether observations are joint positions and velocities"""

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
        env = Unit(_limited(_made(self.gym_id, self.name), self.max_episode_steps), action, obs)
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


def tried(given: Termination, known: Task, name: str) -> Termination:
    """`given`, after a test call. Raises UserError if its answer is not a valid one."""
    try:
        answer = given(torch.zeros(3, known.obs_dim))
    except OF_USERS as error:  # the user's own code
        raise UserError(
            f"termination {name} fails for next observations (3, {known.obs_dim}): "
            f"{type(error).__name__}: {reason(error)}"
        ) from error
    if not isinstance(answer, Tensor) or answer.shape != (3,) or answer.dtype != torch.bool:
        raise UserError(
            f"termination {name} must map next observations (B, {known.obs_dim}), a tensor, to a "
            "bool tensor (B,)"
        )
    return given


def import_named(module: str, option: str) -> ModuleType:
    """Import the module that the user named in `option`, also from the current folder.

    Raises UserError if it cannot be imported.
    """
    here = str(Path.cwd())
    sys.path.append(here)
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        raise UserError(
            f"{option}: no module '{error.name}': install it, or start from the folder it is in"
        ) from error
    except OF_USERS as error:  # errors of the user's code
        raise UserError(
            f"{option}: module '{module}' cannot be imported: "
            f"{type(error).__name__}: {reason(error)}"
        ) from error
    finally:
        sys.path.remove(here)


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
    obs = _box(getattr(env, "observation_space", None), name, "observes")
    action = _actions(getattr(env, "action_space", None), name)
    _take_a_step(name, env, obs, action)
    bounded = _bounded(obs)
    low, high = np.where(bounded, obs.low, -1.0), np.where(bounded, obs.high, 1.0)
    simulator = simulated(env)
    root_dims = None if simulator is None else _root_dims(env, simulator)
    limit = None if env.spec is None else env.spec.max_episode_steps
    return GymnasiumTask(
        name=name,
        gym_id=gym_id,
        terminated=termination.never,
        knows_ends=False,
        steps=STEPS,
        action_dim=len(action.low),
        obs_names=(dm_control.obs_names(env) if dm_control.is_one(gym_id) else None)
        or _obs_names(len(obs.low), simulator, root_dims),
        max_episode_steps=limit or TIME_LIMIT,
        nq=0 if simulator is None else int(simulator.model.nq),
        root_dims=root_dims,
        keeps_states=simulator is not None and root_dims is None,
        action_low=_floats(action.low),
        action_high=_floats(action.high),
        obs_offset=_floats(0.5 * (high + low)),
        obs_scale=_floats(0.5 * (high - low)),
        dt=_seconds(env),
    )


def _take_a_step(name: str, env: gym.Env, obs: Box, action: Box) -> None:
    """Raises UserError if an episode of the task does not match its spaces."""
    try:
        first, _ = env.reset(seed=0)
        chosen = 0.5 * (action.low + action.high)
        second, reward, _, _, _ = env.step(chosen.astype(np.float32))
        seen = [np.asarray(part, np.float64) for part in (first, second)]
        finite = np.isfinite(float(reward)) and all(np.isfinite(part).all() for part in seen)
    except OF_USERS as error:
        raise UserError(
            f"task '{name}' fails at its first step, {type(error).__name__}: {reason(error)}: "
            "its reset and step must be those of gymnasium.Env"
        ) from error
    if any(part.shape != obs.shape for part in seen):
        shapes = " and ".join(str(part.shape) for part in seen)
        raise UserError(
            f"task '{name}' observes {shapes}, its observation space says {obs.shape}: mend one "
            "of them"
        )
    if not finite:
        raise UserError(
            f"task '{name}' gives an observation or a reward at its first step that is no finite "
            "number: mend its reset and step"
        )


def _box(space: gym.Space | None, name: str, does: str) -> Box:
    """`space` as a one-dimensional Box in double precision."""
    if not isinstance(space, Box) or len(space.shape) != 1 or not space.shape[0]:
        kind = type(space).__name__ if not isinstance(space, Box) else f"Box{space.shape}"
        raise UserError(
            f"task '{name}' {does} in a {kind} space, and only a Box of one axis can be used here: "
            "name another task, or wrap it in one that has such a space"
        )
    return Box(space.low.astype(np.float64), space.high.astype(np.float64), dtype=np.float64)


def _actions(space: gym.Space | None, name: str) -> Box:
    box = _box(space, name, "acts")
    if not _bounded(box).all():
        raise UserError(
            f"task '{name}' has actions without bounds: wrap it in gymnasium.wrappers."
            "RescaleAction or give its Box finite bounds"
        )
    return box


def _bounded(box: Box) -> NDArray[np.bool_]:
    """Which dimensions have two finite bounds below `UNBOUNDED`."""
    known = (np.abs(box.low) < UNBOUNDED) & (np.abs(box.high) < UNBOUNDED)
    return known & (box.high > box.low)


def _root_dims(env: gym.Env, simulator: Simulator) -> int | None:
    """How many leading entries of qpos an observation leaves out; None if it is not qpos, qvel."""
    model = simulator.model
    rows, joints, speeds = [], [], []
    obs, _ = env.reset(seed=0)
    env.action_space.seed(0)
    for _ in range(LOOKED_AT):
        rows.append(obs)
        joints.append(simulator.data.qpos.copy())
        speeds.append(simulator.data.qvel.copy())
        obs, _, terminated, truncated, _ = env.step(env.action_space.sample())
        if terminated or truncated:
            obs, _ = env.reset()
    left_out = int(model.nq + model.nv) - len(rows[0])
    if not 0 <= left_out < model.nq or (model.nq != model.nv and left_out > 2):
        return None
    same = np.hstack([np.array(joints)[:, left_out:], np.array(speeds)])
    return left_out if np.allclose(np.array(rows), same, atol=1e-6) else None


def _obs_names(dim: int, simulator: Simulator | None, root_dims: int | None) -> tuple[str, ...]:
    if simulator is None or root_dims is None or simulator.model.nq != simulator.model.nv:
        return tuple(f"observation {i + 1}" for i in range(dim))
    joints = [
        simulator.model.joint(i).name or f"joint {i + 1}" for i in range(simulator.model.njnt)
    ]
    if len(joints) != simulator.model.nq:
        return tuple(f"observation {i + 1}" for i in range(dim))
    return (*joints[root_dims:], *(f"{joint} velocity" for joint in joints))


def _seconds(env: gym.Env) -> float:
    """The duration of a step: the task's `dt`, else that of a frame of its renderer."""
    try:
        seconds = float(env.get_wrapper_attr("dt"))
    except (AttributeError, TypeError, ValueError):
        seconds = 0.0
    frames = env.metadata.get("render_fps")
    if seconds > 0 and np.isfinite(seconds):
        return seconds
    return 1 / float(frames) if isinstance(frames, int | float) and frames > 0 else 1 / 30


def _floats(array: NDArray) -> Floats:
    return tuple(float(value) for value in array)
