"""The rows that a loop hands in, on their way to the record: checked, and in whole episodes."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import isfinite
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from tom.data.transitions import Transitions
from tom.errors import UserError

Autoreset = Literal["next-step", "same-step"]
AUTORESET: tuple[Autoreset, ...] = ("next-step", "same-step")
NUMBER, BOOL = (float, int, np.floating), (bool, np.bool_)
BLOCK = 4096
"""rows that are written at once"""
Columns = tuple[NDArray, ...]
"""obs (N, O), action (N, A), reward (N,), next_obs (N, O), terminated (N,), truncated (N,)"""


@dataclass(frozen=True)
class Ended:
    """An episode that ended with the row handed in as number `at`, counted from 1."""

    at: int
    total: float
    length: int


class Rows:
    """Takes the steps of `envs` environments and passes on their rows, `BLOCK` at a time.

    Rows of several environments are passed on by whole episodes, since a record's neighbours are
    neighbours in time; until then they wait here. Each has the number with which it was handed in,
    counted from 1: step after step, in a step environment after environment.
    """

    def __init__(
        self,
        obs_dim: int,
        action_dim: int,
        write: Callable[[Transitions, NDArray[np.int64]], None],
        envs: int = 1,
        autoreset: Autoreset | None = None,
        handed: int = 0,
    ) -> None:
        """`write` gets rows and their numbers (n,); `handed` rows were handed in before."""
        self.handed, self.envs, self.written = handed, envs, 0
        self._tails = {"obs": (obs_dim,), "action": (action_dim,), "next_obs": (obs_dim,)}
        self._shapes = (obs_dim,), (action_dim,), (obs_dim,)
        self._autoreset, self._write = autoreset, write
        self._plain = envs == 1 and autoreset is None
        self._ended = np.zeros(envs, bool)  # the last step of each environment
        self._waiting: list[list[tuple[Columns, NDArray[np.int64]]]] = [[] for _ in range(envs)]
        self._returns, self._lengths = np.zeros(envs), np.zeros(envs, np.int64)
        shapes = ((obs_dim,), (action_dim,), (), (obs_dim,), (), ())
        kinds = (np.float64, np.float64, np.float64, np.float64, bool, bool)
        self._block = tuple(
            np.empty((BLOCK, *shape), kind) for shape, kind in zip(shapes, kinds, strict=True)
        )
        self._numbers, self._count = np.empty(BLOCK, np.int64), 0

    def add(
        self,
        obs: Any,
        action: Any,
        reward: Any,
        next_obs: Any,
        terminated: Any,
        truncated: Any,
        infos: Mapping[str, Any] | None = None,
    ) -> list[Ended]:
        """Take one step or many; the episodes that ended. Raises UserError, and takes none then.

        Leading axes: none or (T,) steps of one environment; (E,) or (T, E) of several.
        """
        if self._plain:
            one = self._one_step(obs, action, reward, next_obs, terminated, truncated)
            if one is not None:
                return one
        columns = self._checked(obs, action, reward, next_obs, terminated, truncated)
        ends = columns[4] | columns[5]  # (T, E)
        envs = ends.shape[1]
        if self._autoreset == "same-step":
            columns = _with_final_obs(columns, ends, infos)
        first, self.handed = self.handed, self.handed + ends.size
        if self._plain:
            flat = tuple(column[:, 0] for column in columns)
            numbers = np.arange(first + 1, self.handed + 1)
            found = self._episodes(0, flat[2], ends[:, 0], numbers)
            self._pass_on(flat, numbers)
            return found
        kept = np.ones_like(ends)
        if self._autoreset == "next-step":  # the step after an end only resets
            kept = ~_after_end(ends, self._ended)
            self._ended = ends[-1] & kept[-1]
        found = []
        for env in range(envs):
            rows = np.flatnonzero(kept[:, env])
            if len(rows):
                own = tuple(column[rows, env] for column in columns)
                numbers = first + rows * envs + env + 1
                found += self._episodes(env, own[2], ends[rows, env], numbers)
                self._wait(env, own, numbers, ends[rows, env])
        return sorted(found, key=lambda ended: ended.at)

    def _one_step(
        self, obs: Any, action: Any, reward: Any, next_obs: Any, terminated: Any, truncated: Any
    ) -> list[Ended] | None:
        """`add` for a single step, in a third of the time; None if it is anything else."""
        o, a, n = np.asarray(obs), np.asarray(action), np.asarray(next_obs)
        if (o.shape, a.shape, n.shape) != self._shapes or not isinstance(reward, NUMBER):
            return None
        if o.dtype.kind != "f" or n.dtype.kind != "f" or a.dtype.kind != "f":
            return None
        total = np.add.reduce(o) + np.add.reduce(a) + np.add.reduce(n) + reward
        if (
            not isfinite(total)
            or not isinstance(terminated, BOOL)
            or not isinstance(truncated, BOOL)
        ):
            return None
        at, self.handed = self._count, self.handed + 1
        values = (o, a, reward, n, terminated, truncated, self.handed)
        for block, value in zip((*self._block, self._numbers), values, strict=True):
            block[at] = value
        self._count += 1
        self._returns[0] += reward
        self._lengths[0] += 1
        found = []
        if terminated or truncated:
            found = [Ended(self.handed, float(self._returns[0]), int(self._lengths[0]))]
            self._returns[0] = self._lengths[0] = 0
        if self._count == BLOCK:
            self.flush()
        return found

    def flush(self) -> None:
        """Pass on what is complete."""
        count, self._count = self._count, 0
        if count:
            rows = Transitions(*(column[:count] for column in self._block))
            self.written += count
            self._write(rows, self._numbers[:count].copy())

    def close(self) -> None:
        """Pass on everything; an episode that is not over is cut: truncated."""
        for waiting in self._waiting:
            if waiting:
                (*_, terminated, truncated), _ = waiting[-1]
                truncated[-1] |= not terminated[-1]
            for part in waiting:
                self._pass_on(*part)
            waiting.clear()
        self.flush()

    def _checked(self, *given: Any) -> Columns:
        """The columns with axes (T, E, ...). Raises UserError."""
        names = ("obs", "action", "reward", "next_obs", "terminated", "truncated")
        kinds = (np.float64, np.float64, np.float64, np.float64, bool, bool)
        try:
            columns = [np.asarray(x, kind) for x, kind in zip(given, kinds, strict=True)]
        except (TypeError, ValueError) as error:
            raise UserError(f"transitions: no numbers ({error})") from None
        lead = columns[0].shape[:-1]
        fits = len(lead) <= 1 if self.envs == 1 else lead[-1:] == (self.envs,) and len(lead) <= 2
        for name, column in zip(names, columns, strict=True):
            wanted = lead + self._tails.get(name, ())
            if not fits or column.shape != wanted:
                axes = "(T,)" if self.envs == 1 else f"({self.envs},) or (T, {self.envs})"
                raise UserError(
                    f"transitions: {name} has shape {column.shape}; the task's rows are "
                    + ", ".join(f"{n} {t}" for n, t in self._tails.items())
                    + f", with the same leading axes everywhere: {axes}"
                )
            if column.dtype != bool and not np.isfinite(column).all():
                raise UserError(f"transitions: {name} has a value that is no finite number")
        shape = (-1, self.envs)
        return tuple(x.reshape(*shape, *x.shape[len(lead) :]) for x in columns)

    def _episodes(
        self, env: int, reward: NDArray, ends: NDArray[np.bool_], numbers: NDArray[np.int64]
    ) -> list[Ended]:
        found, first = [], 0
        for last in np.flatnonzero(ends).tolist():
            total = self._returns[env] + reward[first : last + 1].sum()
            length = int(self._lengths[env]) + last + 1 - first
            found.append(Ended(int(numbers[last]), float(total), length))
            self._returns[env] = self._lengths[env] = 0
            first = last + 1
        self._returns[env] += reward[first:].sum()
        self._lengths[env] += len(reward) - first
        return found

    def _wait(
        self, env: int, columns: Columns, numbers: NDArray[np.int64], ends: NDArray[np.bool_]
    ) -> None:
        """Keep rows of one environment until their episode has ended."""
        last = np.flatnonzero(ends)
        done = int(last[-1]) + 1 if len(last) else 0
        if done:
            for waiting in self._waiting[env]:
                self._pass_on(*waiting)
            self._waiting[env].clear()
            self._pass_on(tuple(column[:done] for column in columns), numbers[:done])
        if done < len(numbers):
            rest = tuple(column[done:].copy() for column in columns)
            self._waiting[env].append((rest, numbers[done:].copy()))

    def _pass_on(self, columns: Columns, numbers: NDArray[np.int64]) -> None:
        done = 0
        while done < len(numbers):
            at = self._count
            n = min(len(numbers) - done, BLOCK - at)
            for block, column in zip(self._block, columns, strict=True):
                block[at : at + n] = column[done : done + n]
            self._numbers[at : at + n] = numbers[done : done + n]
            self._count, done = at + n, done + n
            if self._count == BLOCK:
                self.flush()


def _after_end(ends: NDArray[np.bool_], before: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Which steps (T, E) follow an end, `before` (E,) being the step before the first."""
    after = np.zeros_like(ends)
    for step in range(len(ends)):
        after[step] = before
        before = ends[step] & ~after[step]
    return after


def _with_final_obs(
    columns: Columns, ends: NDArray[np.bool_], infos: Mapping[str, Any] | None
) -> Columns:
    """The columns with the last observation of each ended episode, which is in `infos`."""
    if not ends.any():
        return columns
    final = (infos or {}).get("final_obs")
    if final is None or len(ends) != 1:
        raise UserError(
            "transitions: with same-step autoreset the next_obs of an ended episode is in "
            "infos['final_obs']: hand in each step with its infos"
        )
    next_obs = columns[3].copy()
    for env in np.flatnonzero(ends[0]).tolist():
        next_obs[0, env] = final[env]
    return *columns[:3], next_obs, *columns[4:]
