"""D4RL's HDF5 files as transitions, in the order of collection."""

from pathlib import Path

from tom.data.hdf5 import column, open_hdf5
from tom.data.recorded import assemble, check_finite
from tom.data.transitions import Transitions
from tom.errors import UserError


def read_d4rl(path: str | Path) -> Transitions:
    """The transitions of a D4RL file (`observations`, `actions`, `rewards`, `terminals`, ...).

    `timeouts` become `truncated`; `assemble` completes a missing `timeouts` or `next_observations`.
    Actions are in the recorded task's own units. Raises UserError.
    """
    with open_hdf5(Path(path)) as file:
        obs, action = column(file, "observations", 2), column(file, "actions", 2)
        reward = column(file, "rewards", 1)
        terminated = column(file, "terminals", 1)
        next_obs = column(file, "next_observations", 2) if "next_observations" in file else None
        timeouts = column(file, "timeouts", 1) if "timeouts" in file else None
    parts = [a for a in (obs, action, reward, terminated, next_obs, timeouts) if a is not None]
    if len({len(a) for a in parts}) > 1 or len(obs) == 0:
        raise UserError(f"{path}: arrays of {[len(a) for a in parts]} rows: fetch the file again")
    if next_obs is not None and next_obs.shape != obs.shape:
        raise UserError(
            f"{path}: 'next_observations' has {next_obs.shape[1]} dimensions, 'observations' has "
            f"{obs.shape[1]}: fetch the file again"
        )
    if next_obs is None and timeouts is None:
        raise UserError(
            f"{path} has neither 'next_observations' nor 'timeouts', so its episodes cannot be "
            "told apart: use a version of the data that has one of them"
        )
    numbers = {"observations": obs, "actions": action, "rewards": reward, "terminals": terminated}
    check_finite(path, {**numbers, "next_observations": next_obs, "timeouts": timeouts})
    return assemble(obs, action, reward, terminated, next_obs, timeouts)
