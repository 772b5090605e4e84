"""DeepMind Control's tasks in Gymnasium, by shimmy: `shimmy:dm_control/walker-walk-v0`.

Their observations are named arrays, which are concatenated here in the order of their names.
dm_control is not imported here and need not be installed.
"""

import os
from importlib.metadata import version
from math import prod
from typing import Any

import gymnasium as gym
from gymnasium.spaces import Box, Dict
from gymnasium.wrappers import FlattenObservation

NAMESPACE = "dm_control/"
PICTURE = 3
"""number of axes of a picture"""


def is_one(gym_id: str) -> bool:
    """Whether the Gymnasium id is that of such a task."""
    return gym_id.startswith(NAMESPACE)


def without_screen() -> None:
    """Tell dm_control not to look for a screen at its import, which gives a warning without one."""
    os.environ.setdefault("MUJOCO_GL", "disable")


def flat(env: gym.Env) -> gym.Env:
    """`env` with its named arrays concatenated; unchanged if one of them is a picture."""
    return FlattenObservation(env) if _named_arrays(env) else env


def obs_names(env: gym.Env) -> tuple[str, ...] | None:
    """The name of each dimension of the flat observation; None if it has no names."""
    if not _named_arrays(env):
        return None
    names: list[str] = []
    for name, space in _arrays(env):
        label, size = name.replace("_", " "), prod(space.shape or ())
        names += [label] if size == 1 else [f"{label} {i + 1}" for i in range(size)]
    return tuple(names)


def advice(error: BaseException) -> str:
    """Advice for the user if such a task cannot be made."""
    if isinstance(error, gym.error.NamespaceNotFound):
        return "; pip install 'shimmy[dm-control]' and write shimmy:dm_control/..."
    if not isinstance(error, AttributeError):
        return ""
    # It reads members that MuJoCo's structures no longer have.
    return f"; dm_control does not know MuJoCo {version('mujoco')}: see docs/tasks.md"


def simulation(env: Any) -> Any:
    """dm_control's physics of an unwrapped environment; None if it is of another kind.

    None also for composed tasks, which compile a new model for every episode.
    """
    if not type(env).__module__.startswith("shimmy.dm_control"):
        return None
    return env.physics if env.env_type.name == "RL_CONTROL" else None


def _arrays(env: gym.Env) -> list[tuple[str, gym.Space]]:
    space = env.unwrapped.observation_space
    return [(str(name), of) for name, of in space.items()] if isinstance(space, Dict) else []


def _named_arrays(env: gym.Env) -> bool:
    arrays = _arrays(env)
    return bool(arrays) and all(isinstance(of, Box) and len(of.shape) < PICTURE for _, of in arrays)
