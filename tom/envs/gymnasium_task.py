"""Any Gymnasium task with Box spaces: `gymnasium:Swimmer-v5`, `my_package:MyTask-v0`.

The module before the colon registers the task when it is imported, as in `gymnasium.make`. It is
code that the user chose: only `describe` imports it, never a reader of runs.
"""

import os
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from importlib.metadata import version
from itertools import chain
from math import prod
from numbers import Real
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.spaces import Box, Dict
from gymnasium.wrappers import FlattenObservation, TimeLimit
from numpy.typing import NDArray

from tom.data.card import dimension_list
from tom.envs import termination
from tom.envs.environment import Simulator, Unit, simulated
from tom.envs.mujoco import log_warnings
from tom.envs.task import Task, Termination
from tom.envs.user_code import import_named
from tom.errors import USER_CODE_ERRORS, UserError, reason

OWN = "gymnasium"
"""the module of Gymnasium's own tasks, which is always imported"""
DM_CONTROL = "dm_control/"
"""begins the ids of DeepMind Control's tasks by shimmy, whose observations are named arrays"""
STEPS = 100_000
"""default number of env steps in an unknown task"""
TIME_LIMIT = 1000
"""length of an episode if the task's specification sets no limit"""
UNBOUNDED = 1e6
"""larger bounds are taken as no bound"""
PLAYED = 50
"""steps of each of the short episodes by which a task is looked at"""
WIDE = 1000
"""bounds that are so many times wider than the values in these episodes are no unit: data go ten
times as far as short episodes"""
FAR, NARROW = 1e4, 1e-4
"""values that lie farther from zero than so many times their changes are shifted; changes smaller
than this are enlarged"""
SMALLEST = 1e-12
"""smaller changes, also relative to the values, are rounding"""
REWARDS = 10
"""rewards of the first of these episodes that a run's description keeps"""
TRIED = 20
"""steps that test whether observations are joint positions and velocities"""

Floats = tuple[float, ...]


@dataclass(frozen=True, kw_only=True)
class GymnasiumTask(Task):
    """A task given by its Gymnasium id, rescaled by its bounds.

    An observation is `(obs - obs_offset) / obs_scale`; actions of -1 and 1 are the bounds; a step
    takes `dt` seconds on the screen. `rewards` are the first of an episode by which a changed task
    is recognised; empty if it does not play one the same way twice.
    """

    gym_id: str
    action_low: Floats
    action_high: Floats
    obs_offset: Floats
    obs_scale: Floats
    dt: float
    rewards: Floats = ()

    def make(self, seed: int | None = None) -> gym.Env[np.ndarray, np.ndarray]:
        env = _make_env(self.gym_id, self.name)
        if env.spec is None or env.spec.max_episode_steps is None:
            env = TimeLimit(env, self.max_episode_steps)
        action = np.array(self.action_low), np.array(self.action_high)
        unit = Unit(env, action, self.obs_units, self.name)
        if seed is not None:
            unit.reset(seed=seed)
        return unit

    def described(self) -> dict[str, Any]:
        names = "gym_id", "action_low", "action_high", "obs_offset", "obs_scale", "dt"
        names += "action_dim", "obs_names", "max_episode_steps", "nq", "root_dims", "knows_ends"
        names += ("rewards",)
        return {name: getattr(self, name) for name in names}

    @cached_property
    def action_bounds(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        return np.array(self.action_low, np.float32), np.array(self.action_high, np.float32)

    @property
    def obs_units(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        return np.array(self.obs_offset), np.array(self.obs_scale)


def describe(name: str) -> GymnasiumTask:
    """The task `module:Id`: imports the module and makes the task once to inspect it.

    Raises UserError if there is no such task, or if it cannot be trained in.
    """
    module, _, gym_id = name.partition(":")
    if not gym_id or ":" in gym_id:
        raise UserError(f"task '{name}': write MODULE:ID, such as gymnasium:Swimmer-v5")
    if gym_id.startswith(DM_CONTROL):  # it looks for a screen at its import, and warns without one
        os.environ.setdefault("MUJOCO_GL", "disable")
    if module != OWN:
        import_named(module, f"--env {name}")
    return inspect_task(name, gym_id)


def inspect_task(name: str, gym_id: str, terminated: Termination | None = None) -> GymnasiumTask:
    """The task of that Gymnasium id, made once to inspect it; `terminated` is its own rule.

    Raises UserError if there is no such task, or if it cannot be trained in.
    """
    env = _make_env(gym_id, name)
    known = _inspect_env(name, gym_id, env)
    env.close()
    if terminated is None:
        return known
    own = termination.checked_rule(terminated, known, f"of {name}")
    return replace(known, terminated=own, knows_ends=True)


def _make_env(gym_id: str, name: str) -> gym.Env:
    """The environment; named arrays are concatenated in the order of their names."""
    log_warnings()
    try:
        made = gym.make(gym_id, disable_env_checker=True)
    except USER_CODE_ERRORS as error:  # Gymnasium's errors as well
        advice, of_dm = "", gym_id.startswith(DM_CONTROL)
        if of_dm and isinstance(error, gym.error.NamespaceNotFound):
            advice = "; pip install 'shimmy[dm-control]' and write shimmy:dm_control/..."
        elif of_dm and isinstance(error, AttributeError):  # it reads what MuJoCo no longer has
            advice = f"; dm_control does not know MuJoCo {version('mujoco')}: see docs/tasks.md"
        elif isinstance(error, gym.error.UnregisteredEnv):  # in this process
            advice = ' If code of yours registers it, name its module too: env="module:Id"'
        raise UserError(f"task '{name}' cannot be made: {reason(error)}{advice}") from error
    return FlattenObservation(made) if _named_arrays(made, gym_id) else made


def _named_arrays(env: gym.Env, gym_id: str) -> dict[str, tuple[int, ...]]:
    """The names and shapes of dm_control's observation; none if one of them is a picture."""
    space = env.unwrapped.observation_space
    if not gym_id.startswith(DM_CONTROL) or not isinstance(space, Dict):
        return {}
    arrays = {str(name): of.shape for name, of in space.items() if isinstance(of, Box)}
    flat = len(arrays) == len(space) and all(len(shape) < 3 for shape in arrays.values())
    return arrays if flat else {}


def _inspect_env(name: str, gym_id: str, env: gym.Env) -> GymnasiumTask:
    obs, action = _box(env.observation_space, name), _box(env.action_space, name)
    if not _bounded(action).all():
        wrong = int(np.flatnonzero(~_bounded(action))[0])
        raise UserError(
            f"task '{name}' has actions without bounds that can be used: those of dimension "
            f"{wrong} are {action.low[wrong]:g} and {action.high[wrong]:g}: give its Box two "
            f"different ones within {UNBOUNDED:g}"
        )
    if not np.issubdtype(env.action_space.dtype, np.floating):
        raise UserError(
            f"task '{name}' acts in whole numbers ({env.action_space.dtype}), and only continuous "
            "actions can be used here: give its Box a floating type, and round in step"
        )
    bounded = _bounded(obs)
    simulator = simulated(env)
    root_dims = _root_dims(env, simulator, obs, action, name)
    unscaled_dims = root_dims if not bounded.any() else None  # joints, in their own units
    tries = [_short_episode(env, action, seed) for seed in (0, 0, 1)]
    repeats = all(map(np.array_equal, tries[0], tries[1]))
    offset, scale, changed = np.zeros(obs.shape), np.ones(obs.shape), np.zeros(obs.shape, bool)
    if unscaled_dims is None:
        starts = [_short_episode(env, action, seed, steps=0) for seed in range(2, 10)]
        rows = [row for seen, _ in (*tries, *starts) for row in seen]
        usable = [row for row in rows if row.shape == obs.shape and np.isfinite(row).all()]
        offset, scale, changed = _units(obs, np.array(usable))
    limit = None if env.spec is None else env.spec.max_episode_steps
    fps = env.metadata.get("render_fps")
    dt = env.get_wrapper_attr("dt") if env.has_wrapper_attr("dt") else None
    return GymnasiumTask(
        name=name,
        gym_id=gym_id,
        terminated=termination.never,
        knows_ends=False,
        steps=STEPS,
        action_dim=len(action.low),
        obs_names=_obs_names(len(obs.low), simulator, root_dims, _named_arrays(env, gym_id)),
        max_episode_steps=limit or TIME_LIMIT,
        nq=0 if simulator is None else int(simulator.model.nq),
        root_dims=unscaled_dims,
        keeps_states=simulator is not None and unscaled_dims is None,
        action_low=tuple(action.low.tolist()),
        action_high=tuple(action.high.tolist()),
        obs_offset=tuple(offset.tolist()),
        obs_scale=tuple(scale.tolist()),
        dt=float(dt) if isinstance(dt, Real) else 1 / (fps or 30),  # any task may use that name
        rewards=tuple(tries[0][1][:REWARDS].tolist()) if repeats else (),
        notices=_notices(name, changed, repeats),
    )


def _short_episode(
    env: gym.Env, action: Box, seed: int, steps: int = PLAYED
) -> tuple[NDArray, NDArray]:
    """Observations (n, O) and rewards (n,) of so many random steps at most.

    They end where the task fails: a training says why.
    """
    rng, seen, rewards = np.random.default_rng(seed), [], []
    with suppress(*USER_CODE_ERRORS):
        seen.append(np.array(env.reset(seed=seed)[0], np.float64))
        for _ in range(steps):
            taken = rng.uniform(action.low, action.high).astype(env.action_space.dtype)
            obs, reward, terminated, truncated, _ = env.step(taken)
            seen.append(np.array(obs, np.float64))
            rewards.append(float(reward))
            if terminated or truncated:
                break
    same = [row for row in seen if row.shape == seen[0].shape]
    return np.array(same), np.array(rewards)


def _units(obs: Box, seen: NDArray) -> tuple[NDArray, NDArray, NDArray[np.bool_]]:
    """Offset and scale (O,) of the observations, and where the values `seen` (n, O) chose them.

    Bounds are the unit, but not those that the values hardly fill. Without bounds values stay as
    they are, unless single precision or an unscaled network would lose them.
    """
    bounded = _bounded(obs)
    low, high = np.where(bounded, obs.low, -1.0), np.where(bounded, obs.high, 1.0)
    offset, scale = 0.5 * (high + low), 0.5 * (high - low)
    if not len(seen):
        return offset, scale, np.zeros(obs.shape, bool)
    span, centre = np.ptp(seen, 0), 0.5 * (seen.max(0) + seen.min(0))
    changes = span > SMALLEST * np.maximum(np.abs(centre), 1)
    wide = bounded & changes & (high - low > WIDE * span)
    free = (~bounded | wide) & changes
    far = free & (np.abs(centre) > FAR * span) & (np.abs(centre) > 1e3)
    narrow = free & (span < NARROW) & ((np.abs(centre) < 1e3 * span) | far)
    offset = np.where(far, centre, np.where(wide, 0.0, offset))
    scale = np.where(narrow, span, np.where(wide, 1.0, scale))
    return offset, scale, wide | far | narrow


def _notices(name: str, changed: NDArray[np.bool_], repeats: bool) -> tuple[tuple[str, str], ...]:
    notices = []
    if changed.any():
        notices.append((
            "scale",
            f"observation {dimension_list(changed)} of {name} changes by a small part of its "
            "bounds, or of its distance from zero: it is scaled by what short episodes saw, not by "
            "its bounds; give the observation space bounds that its values fill",
        ))  # fmt: skip
    if not repeats:
        notices.append((
            "seed",
            f"{name} plays two episodes of the same seed and actions differently: no run in it can "
            "be resumed, --resume begins it anew, and nothing repeats under its seed; draw from "
            "self.np_random, which reset(seed=...) sets",
        ))  # fmt: skip
    return tuple(notices)


def _box(space: gym.Space, name: str) -> Box:
    """`space` as a one-dimensional Box in double precision. Raises UserError if it is none."""
    if not isinstance(space, Box) or len(space.shape) != 1 or not space.shape[0]:
        kind = type(space).__name__ if not isinstance(space, Box) else f"Box{space.shape}"
        raise UserError(
            f"task '{name}' has a {kind} space, and only a Box of one axis can be used here: name "
            "another task, or wrap it in one that has such a space"
        )
    return Box(space.low.astype(np.float64), space.high.astype(np.float64), dtype=np.float64)


def _bounded(box: Box) -> NDArray[np.bool_]:
    """Which dimensions have two finite bounds below `UNBOUNDED`."""
    known = (np.abs(box.low) < UNBOUNDED) & (np.abs(box.high) < UNBOUNDED)
    return known & (box.high > box.low)


def _root_dims(
    env: gym.Env, simulator: Simulator | None, obs: Box, action: Box, name: str
) -> int | None:
    """How many leading entries of qpos an observation leaves out; None if it is not qpos, qvel.

    Takes some random steps, or one without a simulator. Raises OwnCodeError if they fail.
    """
    as_it_is = np.zeros(obs.shape), np.ones(obs.shape)
    unit, rng = Unit(env, (action.low, action.high), as_it_is, name), np.random.default_rng(0)
    seen, _ = unit.reset(seed=0)
    rows, joints = [], []
    for _ in range(TRIED if simulator else 1):
        if simulator:
            rows.append(seen)
            joints.append(np.concatenate((simulator.data.qpos, simulator.data.qvel)))
        seen, _, terminated, truncated, _ = unit.step(rng.uniform(-1, 1, action.shape))
        if terminated or truncated:
            seen, _ = unit.reset()
    if not simulator:
        return None
    nq, nv = int(simulator.model.nq), int(simulator.model.nv)
    left_out = nq + nv - len(obs.low)
    if not 0 <= left_out < nq or (nq != nv and left_out > 2):
        return None
    same = np.allclose(np.array(rows), np.array(joints)[:, left_out:], atol=1e-6)
    return left_out if same else None


def _obs_names(
    dim: int, simulator: Simulator | None, root_dims: int | None, arrays: dict[str, tuple[int, ...]]
) -> tuple[str, ...]:
    """Named arrays, or joints and their velocities if these are hinges and slides alone."""
    if arrays:
        sizes = [(name.replace("_", " "), prod(shape)) for name, shape in arrays.items()]
        each = [[name] if n == 1 else [f"{name} {i + 1}" for i in range(n)] for name, n in sizes]
        return tuple(chain(*each))
    if simulator is not None and root_dims is not None:
        model = simulator.model
        if model.nq == model.nv == model.njnt:
            joints = [model.joint(i).name or f"joint {i + 1}" for i in range(model.njnt)]
            return (*joints[root_dims:], *(f"{joint} velocity" for joint in joints))
    return tuple(f"observation {i + 1}" for i in range(dim))
