"""DeepMind Control's tasks, as shimmy brings them to Gymnasium: `shimmy:dm_control/walker-walk-v0`.

They observe named arrays; here these lie side by side, in the order of their names. Nothing of
dm_control is imported: it need not be installed.
"""

import os
from importlib.metadata import PackageNotFoundError, version
from math import prod
from typing import Any

import gymnasium as gym
from gymnasium.spaces import Box, Dict
from gymnasium.wrappers import FlattenObservation

NAMESPACE = "dm_control/"
PICTURE = 3
"""axes of one"""


def is_one(gym_id: str) -> bool:
    """The Gymnasium id is that of such a task."""
    return gym_id.startswith(NAMESPACE)


def without_screen() -> None:
    """Nothing is rendered here; dm_control looks for a screen when it is imported, and warns."""
    os.environ.setdefault("MUJOCO_GL", "disable")


def flat(env: gym.Env) -> gym.Env:
    """`env` with its named arrays side by side; as it is where one of them is a picture."""
    return FlattenObservation(env) if _named_arrays(env) else env


def obs_names(env: gym.Env) -> tuple[str, ...] | None:
    """What each dimension of the flat observation is called; None where it has no names."""
    if not _named_arrays(env):
        return None
    sizes = {name: prod(space.shape or ()) for name, space in _arrays(env)}
    words = {name: name.replace("_", " ") for name in sizes}
    return tuple(
        words[name] if size == 1 else f"{words[name]} {i + 1}"
        for name, size in sizes.items()
        for i in range(size)
    )


def advice(error: BaseException) -> str:
    """What to do where such a task cannot be made."""
    if isinstance(error, gym.error.NamespaceNotFound):
        return "; pip install 'shimmy[dm-control]' and write shimmy:dm_control/..."
    if not isinstance(error, AttributeError):
        return ""
    return (  # it asks MuJoCo's structures for what they no longer hold
        f"; dm_control {_version('dm_control')} does not know MuJoCo {_version('mujoco')}: see "
        "docs/tasks.md"
    )


def simulation(env: Any) -> Any:
    """dm_control's physics in an unwrapped environment; None in any other.

    Tasks that are composed have none either: they compile a new model for every episode.
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


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "(not installed)"
