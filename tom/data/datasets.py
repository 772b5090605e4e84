"""Read recorded experience in any of the known formats."""

from pathlib import Path

import numpy as np

from tom.data.columnar import SUFFIXES, read_columnar
from tom.data.d4rl import read_d4rl
from tom.data.minari import read_minari
from tom.data.transitions import Transitions
from tom.errors import UserError

FORMATS = "an .npz or Parquet file of transitions, a D4RL file (.hdf5) or a Minari folder"
_HDF5 = (".hdf5", ".h5", ".hdf")
_PICKLES = (".pkl", ".pickle", ".zip", ".pt", ".pth")


def read_dataset(path: str | Path) -> Transitions:
    """The transitions of a dataset (FORMATS), in the order of collection. Raises UserError."""
    path = Path(path)
    if not path.exists():
        raise UserError(f"no data at {path}: give {FORMATS}")
    rows = _read(path)
    if not len(rows):
        raise UserError(
            f"{path} has no 'next_obs', and every row of it is the last one of an episode, which "
            "has no successor then: record 'next_obs' too, or longer episodes"
        )
    return rows


def _read(path: Path) -> Transitions:
    if path.is_dir():
        return read_minari(path)
    if path.suffix in SUFFIXES:
        return read_columnar(path)
    if path.suffix in _PICKLES:
        raise UserError(
            f"{path} may hold pickles, which are code and are not loaded: export the transitions "
            "to .npz (docs/your-own.md has ten lines for stable-baselines3)"
        )
    if path.suffix not in _HDF5:
        raise UserError(f"{path} is of no kind that can be read here: give {FORMATS}")
    return read_d4rl(path)


def initial_obs(transitions: Transitions) -> np.ndarray:
    """The first observation of every episode, (M0, O): draws of the start distribution mu_0.

    An episode starts at the first row and after every terminated or truncated one.
    """
    t = transitions.numpy()
    starts = np.append(True, t.ended()[:-1])
    return np.asarray(t.obs)[starts]
