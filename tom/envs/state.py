"""The exact state of a running environment, so that a resumed run takes the same steps."""

# mujoco is compiled and ships no stubs.
# pyright: reportAttributeAccessIssue=false

from typing import Any, cast

import gymnasium as gym
import mujoco
import numpy as np
import torch
from gymnasium.envs.mujoco import MujocoEnv
from gymnasium.wrappers import OrderEnforcing, RescaleAction, TimeLimit
from torch import Tensor

from tom.envs.unit import Unit

# Ant and Humanoid read these in `step` before they simulate; they lag one step behind qpos.
_LAGGING = ("xpos", "xipos")
_COUNTERS = ("_elapsed_steps", "_has_reset")


def capture(env: gym.Env) -> dict[str, Any]:
    """All state that `env`'s future depends on, as tensors and primitives; `env` must be reset."""
    if isinstance(env, Unit):
        return env.capture()
    simulator = _simulator(env)
    state = np.empty(mujoco.mj_stateSize(simulator.model, mujoco.mjtState.mjSTATE_INTEGRATION))
    mujoco.mj_getState(simulator.model, simulator.data, state, mujoco.mjtState.mjSTATE_INTEGRATION)
    return {
        "integration": torch.from_numpy(state),
        "lagging": {n: torch.tensor(getattr(simulator.data, n)) for n in _LAGGING},
        "random": simulator.np_random.bit_generator.state,
        "action_random": env.action_space.np_random.bit_generator.state,
        "counters": [
            {n: vars(wrapper)[n] for n in _COUNTERS if n in vars(wrapper)}
            for wrapper in _wrappers(env)
        ],
    }


def restore(env: gym.Env, state: dict[str, Any]) -> None:
    """Put `env`, made like the captured one, into exactly the captured state."""
    if isinstance(env, Unit):
        env.restore(state)
        return
    simulator = _simulator(env)
    model, data = simulator.model, simulator.data
    mujoco.mj_resetData(model, data)
    integration: Tensor = state["integration"]
    mujoco.mj_setState(model, data, integration.numpy(), mujoco.mjtState.mjSTATE_INTEGRATION)
    mujoco.mj_forward(model, data)
    for name, values in state["lagging"].items():
        getattr(data, name)[:] = values.numpy()
    simulator.np_random.bit_generator.state = state["random"]
    env.action_space.np_random.bit_generator.state = state["action_random"]
    for wrapper, counters in zip(_wrappers(env), state["counters"], strict=True):
        vars(wrapper).update(counters)


def _simulator(env: gym.Env) -> MujocoEnv:
    return cast(MujocoEnv, env.unwrapped)


def _wrappers(env: gym.Env) -> list[gym.Wrapper]:
    wrappers: list[gym.Wrapper] = []
    while isinstance(env, gym.Wrapper):
        if not isinstance(env, TimeLimit | OrderEnforcing | RescaleAction):
            raise TypeError(f"the state of {type(env).__name__} cannot be captured")
        wrappers.append(env)
        env = env.env
    return wrappers
