"""A running environment: its simulator, any task in units of [-1, 1], and its exact state."""

# mujoco is compiled and ships no stubs.
# pyright: reportAttributeAccessIssue=false

from dataclasses import dataclass
from typing import Any, cast

import gymnasium as gym
import mujoco
import numpy as np
from gymnasium.envs.mujoco import MujocoEnv
from numpy.typing import NDArray

from tom.envs.user_code import running_user_code
from tom.errors import OwnCodeError, StartAgainError

LARGEST = float(np.finfo(np.float32).max)
# Ant and Humanoid read these in `step` before they simulate; they lag one step behind qpos.
_LAGGING = ("xpos", "xipos")
_COUNTERS = ("_elapsed_steps", "_has_reset")


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
    if not type(inner).__module__.startswith("shimmy.dm_control"):
        return None
    wrapped: Any = inner
    if wrapped.env_type.name != "RL_CONTROL":  # composed tasks compile a model for every episode
        return None
    physics = wrapped.physics
    return Simulator(physics.model.ptr, physics.data.ptr, float(env.get_wrapper_attr("dt")))


class Unit(gym.Wrapper):
    """Actions in [-1, 1], observations `(obs - offset) / scale` in float32.

    Every episode has its own seed, drawn from the last given seed. The state of an episode is
    stored as this seed and the actions since, so nothing of the environment's content needs to be
    known.
    """

    def __init__(
        self,
        env: gym.Env,
        action: tuple[NDArray, NDArray],
        obs: tuple[NDArray, NDArray],
        name: str,
    ) -> None:
        """`action` is the lower and upper bounds (A,), `obs` the offset and scale (O,).

        Errors call the task `name`.
        """
        super().__init__(env)
        self._name = name
        self._low, self._high = action
        self._offset, self._scale = obs
        self._seeds = np.random.default_rng()
        self._seed = 0
        self._actions: list[NDArray[np.float32]] = []
        self._obs = np.zeros(0, np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        """Start a new episode; `seed` determines it and all later ones."""
        if seed is not None:
            self._seeds = np.random.default_rng(seed)
        self._seed = int(self._seeds.integers(2**31)) if seed is None else seed
        self._actions = []
        with running_user_code(f"{self._step()} of the task '{self._name}'"):
            obs, info = self.env.reset(seed=self._seed, options=options)
            return self._seen(obs), info

    def step(self, action: NDArray):
        """One step with an action (A,) in [-1, 1].

        Raises OwnCodeError if the task fails, or returns a number that is not finite.
        """
        taken = np.clip(np.asarray(action, np.float32), -1, 1)
        self._actions.append(taken.copy())
        own = self._low + 0.5 * (taken.astype(np.float64) + 1) * (self._high - self._low)
        with running_user_code(f"{self._step()} of the task '{self._name}'"):
            # In the space's own type: rounded to another, a bound may lie outside of it.
            given = own.astype(self.env.action_space.dtype)
            obs, reward, terminated, truncated, info = self.env.step(given)
            if not abs(float(reward)) <= LARGEST:
                raise self._unusable(f"a reward of {float(reward)}")
            return self._seen(obs), float(reward), bool(terminated), bool(truncated), info

    def capture(self) -> dict[str, Any]:
        """The state for `restore`, as tensors and primitives."""
        import torch  # takes seconds; who only shows runs does without it

        width = len(self._low)
        return {
            "seeds": self._seeds.bit_generator.state,
            "seed": self._seed,
            "actions": torch.from_numpy(np.array(self._actions, np.float32).reshape(-1, width)),
            "obs": torch.from_numpy(self._obs.copy()),
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Replay the captured episode up to the step of the capture.

        Raises StartAgainError if the observation there is not the captured one.
        """
        self.reset(seed=state["seed"])
        for action in state["actions"].numpy():
            self.step(action)
        self._seeds.bit_generator.state = state["seeds"]
        if not np.array_equal(self._obs, state["obs"].numpy()):
            raise StartAgainError(
                f"{self.unwrapped.spec.id if self.unwrapped.spec else 'the task'} does not play an "
                "episode the same way again from its seed and actions, so a run in it cannot be "
                "resumed: start it again"
            )

    def _seen(self, obs: NDArray) -> NDArray[np.float32]:
        own = np.asarray(obs, np.float64)
        if own.shape != self._offset.shape:
            raise self._unusable(f"an observation of shape {own.shape}, not {self._offset.shape}")
        with np.errstate(over="ignore"):  # overflow gives infinity, which is reported
            self._obs = ((own - self._offset) / self._scale).astype(np.float32)
        if not np.isfinite(self._obs).all():
            wrong = int(np.flatnonzero(~np.isfinite(self._obs))[0])
            raise self._unusable(f"an observation whose dimension {wrong} is {own[wrong]:g}")
        return self._obs

    def _step(self) -> str:
        step = f"step {len(self._actions)}" if self._actions else "the reset"
        return f"{step} of the episode of seed {self._seed}"

    def _unusable(self, what: str) -> OwnCodeError:
        return OwnCodeError(
            f"the task '{self._name}' gives {what} at {self._step()}: numbers must be finite in "
            "single precision, and of one shape: fix its reset and step"
        )


def capture(env: gym.Env) -> dict[str, Any]:
    """All state that `env`'s future depends on, as tensors and primitives; `env` must be reset."""
    import torch

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
    integration = state["integration"]
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
        wrappers.append(env)
        env = env.env
    return wrappers
