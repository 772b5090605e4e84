"""The MuJoCo tasks: their Gymnasium environments, options, bounds and names.

Agents act in [-1, 1]; `make` rescales to the task's own control range. Nothing here renders.
"""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from types import MappingProxyType

import gymnasium as gym
import mujoco
import numpy as np
from gymnasium.spaces import Box
from gymnasium.wrappers import RescaleAction
from numpy.typing import NDArray

from tom.envs import termination
from tom.envs.task import Task

_log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class MujocoTask(Task):
    """One of the tasks below: an observation is qpos without the root's position, then qvel.

    `steps` is the paper's number of environment steps. `of_paper`: the paper compares learners
    on it.
    """

    gym_id: str
    kwargs: Mapping[str, bool] = field(default_factory=lambda: MappingProxyType({}))

    def make(self, seed: int | None = None) -> gym.Env[np.ndarray, np.ndarray]:
        log_warnings()
        env = gym.make(
            self.gym_id,
            max_episode_steps=self.max_episode_steps,
            disable_env_checker=True,
            **self.kwargs,
        )
        env = RescaleAction(env, np.float32(-1), np.float32(1))
        if seed is not None:
            env.reset(seed=seed)
            env.action_space.seed(seed)
        return env

    @cached_property
    def action_bounds(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        space = self.make().unwrapped.action_space
        assert isinstance(space, Box)
        return space.low, space.high


def log_warnings() -> None:
    """Send MuJoCo's warnings to our log: its own handler writes a file to the working directory."""
    mujoco.set_mju_user_warning(_log.info)  # pyright: ignore[reportAttributeAccessIssue]


def _planar(joints: Sequence[str]) -> tuple[str, ...]:
    angles = [f"{j} angle" for j in joints]
    rates = [f"{j} angular velocity" for j in joints]
    torso = ("torso x velocity", "torso z velocity", "torso angular velocity")
    return ("torso z", "torso angle", *angles, *torso, *rates)


def _free(joints: Sequence[str]) -> tuple[str, ...]:
    pose = ("torso z", *(f"torso quaternion {c}" for c in "wxyz"))
    motion = [f"torso {c} velocity" for c in "xyz"]
    spin = [f"torso {c} angular velocity" for c in "xyz"]
    angles = [f"{j} angle" for j in joints]
    return (*pose, *angles, *motion, *spin, *(f"{j} angular velocity" for j in joints))


def _torques(joints: Sequence[str]) -> tuple[str, ...]:
    return tuple(f"{j} torque" for j in joints)


def _without(*parts: str) -> Mapping[str, bool]:
    return MappingProxyType({f"include_{part}_in_observation": False for part in parts})


_LEG = ("thigh", "leg", "foot")
_LEGS = tuple(f"{side} {part}" for side in ("right", "left") for part in _LEG)
_CHEETAH = tuple(
    f"{side} {part}" for side in ("back", "front") for part in ("thigh", "shin", "foot")
)
_ANT = tuple(f"{joint} {leg}" for leg in range(1, 5) for joint in ("hip", "ankle"))
_HUMANOID = (
    *(f"abdomen {c}" for c in "zyx"),
    *(
        f"{side} {part}"
        for side in ("right", "left")
        for part in ("hip x", "hip z", "hip y", "knee")
    ),
    *(f"{s} {part}" for s in ("right", "left") for part in ("shoulder 1", "shoulder 2", "elbow")),
)

TASKS = (
    MujocoTask(
        name="inverted-pendulum",
        gym_id="InvertedPendulum-v5",
        terminated=termination.inverted_pendulum,
        steps=6_000,  # ours: the paper has no such task
        root_dims=0,
        nq=2,
        action_dim=1,
        obs_names=("cart x", "pole angle", "cart velocity", "pole angular velocity"),
        action_names=("cart force",),
    ),
    MujocoTask(
        name="hopper",
        gym_id="Hopper-v5",
        terminated=termination.hopper,
        steps=125_000,
        root_dims=1,
        nq=6,
        action_dim=3,
        obs_names=_planar(_LEG),
        action_names=_torques(_LEG),
        of_paper=True,
    ),
    MujocoTask(
        name="walker2d",
        gym_id="Walker2d-v5",
        terminated=termination.walker2d,
        steps=300_000,
        root_dims=1,
        nq=9,
        action_dim=6,
        obs_names=_planar(_LEGS),
        action_names=_torques(_LEGS),
        of_paper=True,
    ),
    MujocoTask(
        name="halfcheetah",
        gym_id="HalfCheetah-v5",
        terminated=termination.never,
        steps=300_000,
        root_dims=1,
        nq=9,
        action_dim=6,
        obs_names=_planar(_CHEETAH),
        action_names=_torques(_CHEETAH),
        of_paper=True,
    ),
    MujocoTask(
        name="ant",
        gym_id="Ant-v5",
        terminated=termination.ant,
        steps=300_000,
        root_dims=2,
        nq=15,
        action_dim=8,
        obs_names=_free(_ANT),
        action_names=_torques((*_ANT[6:], *_ANT[:6])),
        kwargs=_without("cfrc_ext"),
        of_paper=True,
    ),
    MujocoTask(
        name="humanoid",
        gym_id="Humanoid-v5",
        terminated=termination.humanoid,
        steps=300_000,
        root_dims=2,
        nq=24,
        action_dim=17,
        obs_names=_free(_HUMANOID),
        action_names=_torques(("abdomen y", "abdomen z", "abdomen x", *_HUMANOID[3:])),
        kwargs=_without("cinert", "cvel", "qfrc_actuator", "cfrc_ext"),
        of_paper=True,
    ),
)
