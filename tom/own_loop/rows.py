"""The rows that a loop hands in, on their way to the record: checked, and in whole episodes."""

from collections.abc import Mapping
from math import ceil, isfinite
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from tom.data.transitions import Transitions
from tom.envs import Task
from tom.errors import UserError

Autoreset = Literal["next-step", "same-step"]
AUTORESET: tuple[Autoreset, ...] = ("next-step", "same-step")
NUMBER, BOOL = (float, int, np.floating), (bool, np.bool_)
BLOCK = 4096
"""rows that are recorded at once"""
NAMES = ("obs", "action", "reward", "next_obs", "terminated", "truncated")
KINDS = (np.float64, np.float64, np.float64, np.float64, bool, bool)
Columns = list[NDArray]
"""the columns of NAMES with the same leading axes"""
Ended = tuple[int, float, int]
"""an episode: the number of its last row, counted from 1, its return and its length"""
Part = tuple[Columns, NDArray[np.int64]]
"""rows (n, ...) in the order of collection, and the numbers (n,) with which they were handed in"""


class Rows:
    """Takes the steps of `envs` environments; `blocks` gives their rows as they are recorded.

    Rows of several environments are given by whole episodes, since a record's neighbours are
    neighbours in time; until then they wait here. Each has the number with which it was handed in,
    counted from 1: step after step, in a step environment after environment.
    """

    def __init__(
        self,
        known: Task,
        envs: int,
        autoreset: Autoreset | None,
        handed: int,
        numbers: NDArray[np.int64],
    ) -> None:
        """`handed` rows were handed in before; those with `numbers` (N,) are in the record."""
        self.handed, self.envs, self._autoreset = handed, envs, autoreset
        self._known, self._recorded = known, [numbers]
        obs, action = (known.obs_dim,), (known.action_dim,)
        self._shapes: dict[str, tuple[int, ...]] = {"obs": obs, "action": action, "next_obs": obs}
        self._one_by_one = envs == 1 and autoreset is None
        self._ended = np.zeros(envs, bool)  # the last step of each environment
        self._waiting: list[list[Part]] = [[] for _ in range(envs)]
        self._returns, self._lengths = [0.0] * envs, [0] * envs
        self._steps: list[tuple] = []  # single steps, as lists of numbers: the fastest to append
        self._parts: list[Part] = []
        self.count = 0
        """rows that are complete and not yet given"""

    @property
    def recorded(self) -> NDArray[np.int64]:
        """The number (N,) with which each row of the record was handed in."""
        self._recorded = [np.concatenate(self._recorded)]
        return self._recorded[0]

    def add(self, step: tuple[Any, ...], infos: Mapping[str, Any] | None = None) -> list[Ended]:
        """Take one step or many, NAMES; the episodes that ended.

        Leading axes: none or (T,) steps of one environment; (E,) or (T, E) of several. Raises
        UserError, and takes none then.
        """
        if self._one_by_one and self._is_single(step):
            return self._add_single(*step)
        self._join_steps()
        columns = self._checked(step)
        reward, ends = columns[2], columns[4] | columns[5]  # (T, E)
        if self._autoreset == "same-step":
            columns = _with_final_obs(columns, ends, infos)
        columns = self._as_recorded(columns)
        first, self.handed = self.handed, self.handed + ends.size
        kept = np.ones_like(ends)
        if self._autoreset == "next-step":  # the step after an end only resets
            for t in range(len(ends)):
                kept[t] = ~self._ended
                self._ended = ends[t] & kept[t]
        found: list[Ended] = []
        for env in range(self.envs):
            rows = np.flatnonzero(kept[:, env]) if self._autoreset else slice(None)
            numbers = np.arange(first + env + 1, self.handed + 1, self.envs)[rows]
            own, lasts = [column[rows, env] for column in columns], np.flatnonzero(ends[rows, env])
            found += self._episodes(env, reward[rows, env], lasts.tolist(), numbers)
            # Complete are rows whose episode has ended; of a single environment all.
            done = len(numbers) if self._one_by_one else int(lasts[-1]) + 1 if len(lasts) else 0
            if done:
                self._complete(env, ([column[:done] for column in own], numbers[:done]))
            if done < len(numbers):
                self._waiting[env].append(([column[done:] for column in own], numbers[done:]))
        return sorted(found)

    def blocks(self) -> list[tuple[Transitions, NDArray[np.int64]]]:
        """The complete rows, as agents see them, and their numbers (n,): blocks of BLOCK or so."""
        self._join_steps()
        parts, self._parts, self.count = self._parts, [], 0
        if not parts:
            return []
        rows = Transitions.concatenate([Transitions(*columns) for columns, _ in parts])
        numbers = np.concatenate([numbers for _, numbers in parts])
        self._recorded.append(numbers)
        size = ceil(len(rows) / max(len(rows) // BLOCK, 1))
        return [(rows[i : i + size], numbers[i : i + size]) for i in range(0, len(rows), size)]

    def cut(self) -> bool:
        """Complete every row; an episode that is not over is truncated: whether there was one.

        Of a single environment its last row is no longer here.
        """
        for env, waiting in enumerate(self._waiting):
            if waiting:
                (*_, terminated, truncated), _ = waiting[-1]
                truncated[-1] |= not terminated[-1]
            self._complete(env)
        running, self._ended = any(self._lengths), np.zeros(self.envs, bool)
        self._returns, self._lengths = [0.0] * self.envs, [0] * self.envs
        return running

    def unfinished_obs(self) -> NDArray[np.float32]:
        """The observations (n, O), as agents see them, of rows whose episodes are not over."""
        waiting = [columns[0] for parts in self._waiting for columns, _ in parts]
        return np.concatenate([np.zeros((0, *self._shapes["obs"]), np.float32), *waiting])

    def in_record(self, given: NDArray[np.float64]) -> NDArray[np.float64]:
        """The weights of the newest rows of the record, up to the oldest that has one.

        `given` (N,) are those of the newest N rows handed in. A row between that the caller does
        not hold any more has none: zero.
        """
        place = self.recorded - 1 - (self.handed - len(given))
        place = place[np.argmax(place >= 0) if (place >= 0).any() else len(place) :]
        return np.where(place >= 0, given[np.maximum(place, 0)], 0.0)

    def _is_single(self, step: tuple[Any, ...]) -> bool:
        obs, action, reward, next_obs, terminated, truncated = step
        try:
            shapes = {"obs": obs.shape, "action": action.shape, "next_obs": next_obs.shape}
        except AttributeError:
            return False
        return (
            shapes == self._shapes
            and isinstance(reward, NUMBER)
            and isinstance(terminated, BOOL)
            and isinstance(truncated, BOOL)
        )

    def _add_single(
        self, obs: Any, action: Any, reward: Any, next_obs: Any, terminated: Any, truncated: Any
    ) -> list[Ended]:
        row = obs.tolist(), action.tolist(), reward, next_obs.tolist(), terminated, truncated
        if not isfinite(sum(row[0]) + sum(row[1]) + reward + sum(row[3])):
            raise UserError("a step has a value that is not a finite number")
        self._steps.append(row)
        self.count += 1
        self.handed += 1
        self._returns[0] += reward
        self._lengths[0] += 1
        if not (terminated or truncated):
            return []
        ended = self.handed, float(self._returns[0]), self._lengths[0]
        self._returns[0], self._lengths[0] = 0.0, 0
        return [ended]

    def _join_steps(self) -> None:
        if self._steps:
            columns = zip(zip(*self._steps, strict=True), KINDS, strict=True)
            numbers = np.arange(self.handed - len(self._steps), self.handed) + 1
            rows = self._as_recorded([np.array(column, kind) for column, kind in columns])
            self._parts.append((rows, numbers))
            self._steps = []

    def _as_recorded(self, columns: Columns) -> Columns:
        """Copies of the columns, as agents see them."""
        obs, action, reward, next_obs, terminated, truncated = columns
        return [
            self._known.unit_obs(obs), self._known.unit_action(action), reward.astype(np.float32),
            self._known.unit_obs(next_obs), terminated.copy(), truncated.copy(),
        ]  # fmt: skip

    def _checked(self, step: tuple[Any, ...]) -> Columns:
        """The columns with axes (T, E, ...). Raises UserError, ValueError or TypeError."""
        columns = [np.asarray(x, kind) for x, kind in zip(step, KINDS, strict=True)]
        lead = columns[0].shape[:-1]
        fits = len(lead) <= 1 if self.envs == 1 else lead[-1:] == (self.envs,) and len(lead) <= 2
        for name, column in zip(NAMES, columns, strict=True):
            if not fits or column.shape != lead + self._shapes.get(name, ()):
                axes = "(T,)" if self.envs == 1 else f"({self.envs},) or (T, {self.envs})"
                raise UserError(
                    f"{name} has shape {column.shape}; the task's rows are "
                    + ", ".join(f"{n} {t}" for n, t in self._shapes.items())
                    + f", with the same leading axes everywhere: {axes}"
                )
            if column.dtype != bool and not isfinite(column.sum()):  # faster than each value's
                raise UserError(f"{name} has a value that is not a finite number")
        return [x.reshape(-1, self.envs, *x.shape[len(lead) :]) for x in columns]

    def _episodes(
        self, env: int, reward: NDArray, lasts: list[int], numbers: NDArray[np.int64]
    ) -> list[Ended]:
        found, first = [], 0
        for last in lasts:
            total = self._returns[env] + float(reward[first : last + 1].sum())
            found.append((int(numbers[last]), total, self._lengths[env] + last + 1 - first))
            self._returns[env], self._lengths[env] = 0.0, 0
            first = last + 1
        self._returns[env] += float(reward[first:].sum())
        self._lengths[env] += len(reward) - first
        return found

    def _complete(self, env: int, *last: Part) -> None:
        """What waits of an environment, and `last`, may be recorded."""
        done = [*self._waiting[env], *last]
        self._waiting[env] = []
        self._parts += done
        self.count += sum(len(numbers) for _, numbers in done)


def _with_final_obs(
    columns: Columns, ends: NDArray[np.bool_], infos: Mapping[str, Any] | None
) -> Columns:
    """The columns with the last observation of each ended episode, which is in `infos`."""
    if not ends.any():
        return columns
    final = (infos or {}).get("final_obs")
    if final is None or len(ends) != 1:
        raise UserError(
            "with same-step autoreset the next_obs of an ended episode is in infos['final_obs']: "
            "hand in each step with its infos"
        )
    next_obs = columns[3].copy()
    for env in np.flatnonzero(ends[0]).tolist():
        next_obs[0, env] = final[env]
    return [*columns[:3], next_obs, *columns[4:]]
