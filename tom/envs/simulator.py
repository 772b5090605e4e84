"""The MuJoCo simulation inside an environment of Gymnasium or of DeepMind Control."""

from dataclasses import dataclass
from typing import Any

import gymnasium as gym
from gymnasium.envs.mujoco import MujocoEnv

from tom.envs import dm_control


@dataclass(frozen=True)
class Simulator:
    """MuJoCo's own model and data, which the environment steps, and the seconds of a step."""

    model: Any
    data: Any
    dt: float


def simulated(env: gym.Env) -> Simulator | None:
    """The simulation inside `env`; None if `env` is of another kind."""
    inner = env.unwrapped
    if isinstance(inner, MujocoEnv):
        return Simulator(inner.model, inner.data, float(inner.dt))
    physics = dm_control.simulation(inner)
    if physics is None:
        return None
    return Simulator(physics.model.ptr, physics.data.ptr, float(env.get_wrapper_attr("dt")))
