"""A small task, its odd relatives, and inputs that are not what they claim to be.

The task is a point on a line: obs (x, v), an action in [-1, 1], ends at |x| > 1, time limit 50.
Every case is made of the same good rows by one change that public reports tell of.
"""

from functools import cache

import gymnasium as gym
import numpy as np
import torch
from gymnasium.spaces import Box
from numpy.typing import NDArray
from torch import Tensor

LIMIT = 50
N = 2000
Columns = dict[str, NDArray]


class Line(gym.Env):
    """The task itself."""

    bounds = (-1.0, 1.0)
    limits = (-np.inf, np.inf)
    scale, offset = np.ones(2), np.zeros(2)
    obs_type: type = np.float32

    def __init__(self, **_: object) -> None:
        self.observation_space = Box(*self.limits, (2,), np.float32)
        self.action_space = Box(*self.bounds, (1,), np.float32)
        self.x, self.v, self.n = 0.0, 0.0, 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x, self.v, self.n = float(self.np_random.uniform(-0.1, 0.1)), 0.0, 0
        return self.seen(), {}

    def seen(self) -> NDArray:
        return (np.array([self.x, self.v]) * self.scale + self.offset).astype(self.obs_type)

    def step(self, action) -> tuple[NDArray, float, bool, bool, dict]:
        self.n += 1
        self.v = 0.9 * self.v + 0.1 * float(action[0]) + 0.02 * float(self.np_random.normal())
        self.x += 0.2 * self.v
        return self.seen(), self.reward(), abs(self.x) > 1, False, {}

    def reward(self) -> float:
        return 1.0 - self.x**2


class Restless(Line):
    """Ignores its seed."""

    def reset(self, *, seed=None, options=None):
        return super().reset(seed=None)


class Both(Line):
    """Ends after 20 steps, by its own limit, with both flags."""

    def step(self, action):
        obs, reward, terminated, _, info = super().step(action)
        ended = terminated or self.n == 20
        return obs, reward, ended, ended, info


def register(name: str, kind: type[Line] = Line, limit: int = LIMIT, **parts: object) -> str:
    """Register a relative, with these attributes; its name for `--env`."""
    gym.register(f"{name}-v0", type(name, (kind,), parts), max_episode_steps=limit)  # pyright: ignore[reportArgumentType]
    return f"line_cases:{name}-v0"


LINE = register("Line")
FAR = register("LineFar", offset=np.array([1.7e9, 0.0]), obs_type=np.float64)
FLAT = register("LineFlat", scale=np.array([1.0, 1e-7]))
TWICE = register("LineTwice", bounds=(-2.0, 2.0))
RESTLESS, BOTH = register("LineRestless", Restless), register("LineBoth", Both)


@cache
def _good() -> Columns:
    env, rng = gym.make("Line-v0"), np.random.default_rng(0)
    rows, push = [], 0.0
    obs, _ = env.reset(seed=0)
    while len(rows) < N:
        push = 0.8 * push + 0.4 * float(rng.normal())
        action = np.clip([push + 0.1], -1, 1).astype(np.float32)
        following, reward, terminated, truncated, _ = env.step(action)
        rows.append((obs, action, float(reward), following, terminated, truncated))
        obs = env.reset()[0] if terminated or truncated else following
    obs, action, reward, following, terminated, truncated = map(np.array, zip(*rows, strict=True))
    return {
        "obs": obs, "action": action, "reward": reward.astype(np.float32), "next_obs": following,
        "terminated": terminated, "truncated": truncated,
    }  # fmt: skip


def good() -> Columns:
    """2 000 rows of a wandering policy, which says what it should."""
    return dict(_good())


def ends(columns: Columns) -> NDArray[np.bool_]:
    return columns["terminated"] | columns["truncated"]


def without(*names: str) -> Columns:
    return {name: values for name, values in good().items() if name not in names}


def noise(columns: Columns) -> Columns:
    drawn = np.random.default_rng(1).normal(scale=1e-7, size=(N, 2))
    noisy = (columns["next_obs"] + drawn).astype(np.float32)
    return without("truncated") | {"next_obs": noisy}


def ordered(columns: Columns, order: NDArray) -> Columns:
    return {name: values[order] for name, values in columns.items()}


def next_step_reset(columns: Columns) -> Columns:
    """A row after each end, whose action is ignored and which leads to the next start."""
    after = np.flatnonzero(ends(columns)[:-1])
    extra = {
        "obs": columns["next_obs"][after], "next_obs": columns["obs"][after + 1],
        "action": np.zeros((len(after), 1), np.float32), "reward": np.zeros(len(after), np.float32),
        "terminated": np.zeros(len(after), bool), "truncated": np.zeros(len(after), bool),
    }  # fmt: skip
    return {n: np.insert(values, after + 1, extra[n], axis=0) for n, values in columns.items()}


def first(rows: int) -> Columns:
    return {name: values[:rows] for name, values in good().items()}


def moved(scale: tuple[float, float], offset: tuple[float, float]) -> Columns:
    columns = good()
    units = np.array(scale), np.array(offset)
    pairs = {n: columns[n].astype(np.float64) * units[0] + units[1] for n in ("obs", "next_obs")}
    return columns | pairs


# Termination rules


def right(next_obs: Tensor) -> Tensor:
    return next_obs[:, 0].abs() > 1


def inverted(next_obs: Tensor) -> Tensor:
    return ~right(next_obs)


# Policies


class Network(torch.nn.Module):
    """Pushes to the middle; the subclasses' answers differ in what they are."""

    def __init__(self) -> None:
        super().__init__()
        self.gain = torch.nn.Parameter(torch.tensor([[-1.0], [-0.5]]))

    def mean(self, obs: Tensor) -> Tensor:
        return obs @ self.gain

    def forward(self, obs: Tensor) -> tuple[Tensor, Tensor]:
        return self.mean(obs), self.mean(obs) * 0 - 1.0


class Deviating(Network):
    def forward(self, obs: Tensor) -> tuple[Tensor, Tensor]:
        return self.mean(obs), self.mean(obs) * 0 + 0.37


class Valued(Network):
    def forward(self, obs: Tensor) -> tuple[Tensor, Tensor]:
        return torch.tanh(self.mean(obs)), self.mean(obs) + 40.0


class Acting(Network):
    def forward(self, obs: Tensor) -> Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]
        return torch.tanh(5 * self.mean(obs))


def outside(obs: NDArray) -> NDArray:
    return np.full((len(obs), 1), 50.0)
