"""D4RL's HDF5 files as transitions, in the order of collection."""

from pathlib import Path

import numpy as np

from tom.data.hdf5 import column, open_hdf5
from tom.data.transitions import Transitions
from tom.errors import UserError


def read_d4rl(path: str | Path) -> Transitions:
    """The transitions of a D4RL file (`observations`, `actions`, `rewards`, `terminals`, ...).

    `timeouts` become `truncated`, and so does every other place where the recording of an episode
    stops without a terminal state: a row after a terminated or truncated one starts an episode.
    Where the file has no `next_observations`, the next row's observation is taken, never across
    episodes: the last row of each episode has none and is left out, and the row before it is
    marked as truncated. Actions are in the recorded task's own units. Raises UserError.
    """
    with open_hdf5(Path(path)) as file:
        obs, action = column(file, "observations", 2), column(file, "actions", 2)
        reward = column(file, "rewards", 1)
        terminated = column(file, "terminals", 1) != 0
        next_obs = column(file, "next_observations", 2) if "next_observations" in file else None
        timeouts = column(file, "timeouts", 1) != 0 if "timeouts" in file else None
    parts = [a for a in (obs, action, reward, terminated, next_obs, timeouts) if a is not None]
    if len({len(a) for a in parts}) > 1 or len(obs) == 0:
        raise UserError(f"{path}: arrays of {[len(a) for a in parts]} rows: fetch the file again")
    if next_obs is None and timeouts is None:
        raise UserError(
            f"{path} has neither 'next_observations' nor 'timeouts', so its episodes cannot be "
            "told apart: use a version of the data that has one of them"
        )
    if next_obs is None:
        ends = terminated | timeouts
        ends[-1] = True
        return _shifted(obs, action, reward, ends)
    if timeouts is None:
        timeouts = np.append((next_obs[:-1] != obs[1:]).any(axis=1), True)
    timeouts[-1] = True
    return Transitions(obs, action, reward, next_obs, terminated, timeouts & ~terminated)


def _shifted(
    obs: np.ndarray, action: np.ndarray, reward: np.ndarray, ends: np.ndarray
) -> Transitions:
    """All rows but the last of each episode, with the next row's observation."""
    kept = np.flatnonzero(~ends)
    terminated = np.zeros(len(kept), bool)
    return Transitions(
        obs[kept], action[kept], reward[kept], obs[kept + 1], terminated, ends[kept + 1]
    )
