"""Recorded experience from disk, whatever its format."""

from pathlib import Path

import numpy as np

from tom.data.d4rl import read_d4rl
from tom.data.minari import read_minari
from tom.data.transitions import Transitions
from tom.errors import UserError


def read_dataset(path: str | Path) -> Transitions:
    """The transitions of a D4RL file or a Minari folder, in the order of collection."""
    if not Path(path).exists():
        raise UserError(f"no data at {path}: give a D4RL file (.hdf5) or a Minari folder")
    return read_minari(path) if Path(path).is_dir() else read_d4rl(path)


def initial_obs(transitions: Transitions) -> np.ndarray:
    """The first observation of every episode, (M0, O): draws of the start distribution mu_0.

    An episode starts at the first row and after every terminated or truncated one.
    """
    t = transitions.numpy()
    ended = (np.asarray(t.terminated) != 0) | (np.asarray(t.truncated) != 0)
    starts = np.append(True, ended[:-1])
    return np.asarray(t.obs)[starts]
