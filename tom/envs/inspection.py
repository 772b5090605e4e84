"""What an environment shows of itself: its spaces, a first step, joints, seconds of a step."""

import gymnasium as gym
import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray

from tom.envs.environment import Simulator
from tom.envs.user_code import place
from tom.errors import OF_USERS, UserError, reason

UNBOUNDED = 1e6
"""larger bounds are taken as no bound"""
LOOKED_AT = 20
"""steps that test whether observations are joint positions and velocities"""


def box_of(space: gym.Space | None, name: str, does: str) -> Box:
    """`space` as a one-dimensional Box in double precision; UserError if it is none."""
    if not isinstance(space, Box) or len(space.shape) != 1 or not space.shape[0]:
        kind = type(space).__name__ if not isinstance(space, Box) else f"Box{space.shape}"
        raise UserError(
            f"task '{name}' {does} in a {kind} space, and only a Box of one axis can be used here: "
            "name another task, or wrap it in one that has such a space"
        )
    return Box(space.low.astype(np.float64), space.high.astype(np.float64), dtype=np.float64)


def actions_of(space: gym.Space | None, name: str) -> Box:
    """The space of actions as a Box (`box_of`).

    Raises UserError if it is none, has no bounds that can be used, or holds whole numbers.
    """
    box = box_of(space, name, "acts")
    if not bounded_dims(box).all():
        wrong = int(np.flatnonzero(~bounded_dims(box))[0])
        raise UserError(
            f"task '{name}' has actions without bounds that can be used: those of dimension "
            f"{wrong} are {box.low[wrong]:g} and {box.high[wrong]:g}: give its Box two different "
            f"ones within {UNBOUNDED:g}"
        )
    if not np.issubdtype(getattr(space, "dtype", np.float32), np.floating):
        raise UserError(
            f"task '{name}' acts in whole numbers ({getattr(space, 'dtype', None)}), and only "
            "continuous actions can be used here: give its Box a floating type, and round in step"
        )
    return box


def bounded_dims(box: Box) -> NDArray[np.bool_]:
    """Which dimensions have two finite bounds below `UNBOUNDED`."""
    known = (np.abs(box.low) < UNBOUNDED) & (np.abs(box.high) < UNBOUNDED)
    return known & (box.high > box.low)


def take_a_step(name: str, env: gym.Env, obs: Box, action: Box) -> None:
    """Raises UserError if an episode of the task does not match its spaces."""
    try:
        first, _ = env.reset(seed=0)
        chosen = 0.5 * (action.low + action.high)
        given = chosen.astype(getattr(env.action_space, "dtype", np.float32))
        second, reward, _, _, _ = env.step(given)
        seen = [np.asarray(part, np.float64) for part in (first, second)]
        finite = np.isfinite(float(reward)) and all(np.isfinite(part).all() for part in seen)
    except OF_USERS as error:
        raise UserError(
            f"task '{name}' fails at its first step, {type(error).__name__}: {reason(error)}"
            f"{place(error)}: its reset and step must be those of gymnasium.Env"
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


def root_dims_of(env: gym.Env, simulator: Simulator, name: str) -> int | None:
    """How many leading entries of qpos an observation leaves out; None if it is not qpos, qvel.

    Raises UserError if the task fails in these steps.
    """
    model = simulator.model
    try:
        rows, joints, speeds = _looked_at(env, simulator)
    except OF_USERS as error:
        raise UserError(
            f"task '{name}' fails in its first {LOOKED_AT} steps, {type(error).__name__}: "
            f"{reason(error)}{place(error)}: mend its reset and step"
        ) from error
    if shapes := {row.shape for row in rows} - {rows[0].shape}:
        raise UserError(
            f"task '{name}' observes {rows[0].shape} and then {min(shapes)}: mend its reset and "
            "step"
        )
    left_out = int(model.nq + model.nv) - len(rows[0])
    if not 0 <= left_out < model.nq or (model.nq != model.nv and left_out > 2):
        return None
    same = np.hstack([np.array(joints)[:, left_out:], np.array(speeds)])
    return left_out if np.allclose(np.array(rows), same, atol=1e-6) else None


def _looked_at(
    env: gym.Env, simulator: Simulator
) -> tuple[list[NDArray], list[NDArray], list[NDArray]]:
    """Observations of some random steps, with qpos and qvel."""
    rows, joints, speeds = [], [], []
    obs, _ = env.reset(seed=0)
    env.action_space.seed(0)
    for _ in range(LOOKED_AT):
        rows.append(np.array(obs))  # a copy: some tasks return an array that they go on changing
        joints.append(simulator.data.qpos.copy())
        speeds.append(simulator.data.qvel.copy())
        obs, _, terminated, truncated, _ = env.step(env.action_space.sample())
        if terminated or truncated:
            obs, _ = env.reset()
    return rows, joints, speeds


def obs_names_of(dim: int, simulator: Simulator | None, root_dims: int | None) -> tuple[str, ...]:
    if simulator is None or root_dims is None or simulator.model.nq != simulator.model.nv:
        return tuple(f"observation {i + 1}" for i in range(dim))
    joints = [
        simulator.model.joint(i).name or f"joint {i + 1}" for i in range(simulator.model.njnt)
    ]
    if len(joints) != simulator.model.nq:
        return tuple(f"observation {i + 1}" for i in range(dim))
    return (*joints[root_dims:], *(f"{joint} velocity" for joint in joints))


def seconds_of(env: gym.Env) -> float:
    """The duration of a step: the task's `dt`, else that of a frame of its renderer."""
    try:
        seconds = float(env.get_wrapper_attr("dt"))
    except (AttributeError, TypeError, ValueError):
        seconds = 0.0
    frames = env.metadata.get("render_fps")
    if seconds > 0 and np.isfinite(seconds):
        return seconds
    return 1 / float(frames) if isinstance(frames, int | float) and frames > 0 else 1 / 30
