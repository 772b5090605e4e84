"""Minari's dataset folders as transitions, episode by episode in the order of collection.

The files (HDF5, Arrow or Parquet) are read directly, so the `minari` package is not needed.
"""

import json
from collections.abc import Iterator
from pathlib import Path

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.dataset

from tom.data.hdf5 import column, member, open_hdf5
from tom.data.recorded import check_finite
from tom.data.transitions import Transitions
from tom.errors import UserError, reason

CHECKED = ("obs", "action", "reward", "next_obs")


def read_minari(path: str | Path) -> Transitions:
    """The transitions of the Minari dataset in folder `path` (with `data/`, or `data/` itself).

    Only flat (Box) observations and actions can be read. An episode that was cut short without
    either flag is marked as truncated, so a row after a terminated or truncated one always starts
    an episode. Actions are in the recorded task's own units. Raises UserError.
    """
    folder = Path(path)
    folder = folder / "data" if (folder / "data").is_dir() else folder
    form = _data_format(folder)
    parts = list(_hdf5_episodes(folder) if form == "hdf5" else _arrow_episodes(folder, form))
    if not parts:
        raise UserError(f"{path} holds no episodes: record or download the dataset again")
    widths = {(np.shape(part.obs)[1], np.shape(part.action)[1]) for part in parts}
    if len(widths) > 1:
        raise UserError(f"{path}: its episodes are of different tasks: their rows differ in width")
    rows = Transitions.concatenate(parts).numpy()
    check_finite(path, {name: np.asarray(getattr(rows, name)) for name in CHECKED})
    return rows


def _data_format(folder: Path) -> str:
    metadata = folder / "metadata.json"
    if not metadata.is_file():
        if (folder / "main_data.hdf5").is_file():
            return "hdf5"  # Minari before 0.5 kept its metadata inside this file
        raise UserError(f"{folder} is not a Minari dataset: no metadata.json or main_data.hdf5")
    try:
        form = json.loads(metadata.read_text()).get("data_format", "hdf5")
    except (ValueError, AttributeError, RecursionError) as error:
        raise UserError(f"{metadata} is damaged: download the dataset again") from error
    if form not in ("hdf5", "arrow", "parquet"):
        raise UserError(f"{metadata}: data format '{form}' is not known: hdf5, arrow, parquet")
    return form


def _hdf5_episodes(folder: Path) -> Iterator[Transitions]:
    with open_hdf5(folder / "main_data.hdf5") as file:
        names = [n for n in map(str, file) if n.removeprefix("episode_").isdecimal()]
        for name in sorted(names, key=lambda n: int(n.removeprefix("episode_"))):
            group = member(file, name)
            if not isinstance(group, h5py.Group):
                raise UserError(f"{folder}: {name} is no episode: download the dataset again")
            axes = {"observations": 2, "actions": 2}
            fields = ("observations", "actions", "rewards", "terminations", "truncations")
            yield _episode(f"{folder}: {name}", *(column(group, f, axes.get(f, 1)) for f in fields))


def _arrow_episodes(folder: Path, form: str) -> Iterator[Transitions]:
    numbered = [f for f in folder.iterdir() if f.is_dir() and f.name.isdecimal()]
    for episode in sorted(numbered, key=lambda f: int(f.name)):
        try:
            table = pyarrow.dataset.dataset(
                episode, format=form, ignore_prefixes=["_", ".", "metadata.json"]
            ).to_table()
            obs, action = _rows(table, "observations"), _rows(table, "actions")
            flat = [_flat(table, f) for f in ("rewards", "terminations", "truncations")]
        except (pa.ArrowException, KeyError, TypeError, ValueError, OSError) as error:
            raise UserError(
                f"{episode} cannot be read: download it again ({reason(error)})"
            ) from error
        # All columns are as long as the observations: the last row of the others is padding.
        yield _episode(str(episode), obs, action[:-1], *flat)


def _flat(table: pa.Table, name: str) -> np.ndarray:
    """A column without its last row."""
    stored = table[name].slice(0, max(len(table) - 1, 0))
    if stored.null_count:
        raise ValueError(f"column '{name}' has {stored.null_count} rows without a value")
    return stored.to_numpy().astype(np.float32)


def _rows(table: pa.Table, name: str) -> np.ndarray:
    stored = table[name].combine_chunks()
    if stored.null_count:
        raise ValueError(f"column '{name}' has {stored.null_count} rows without a value")
    if not pa.types.is_fixed_size_list(stored.type):
        raise UserError(f"'{name}' is {stored.type}: only flat observations and actions are read")
    return stored.flatten().to_numpy().reshape(len(stored), stored.type.list_size)


def _episode(
    where: str,
    obs: np.ndarray,
    action: np.ndarray,
    reward: np.ndarray,
    terminated: np.ndarray,
    truncated: np.ndarray,
) -> Transitions:
    """One episode of T steps from its T + 1 observations."""
    if {len(action), len(reward), len(terminated), len(truncated)} != {len(obs) - 1}:
        raise UserError(f"{where}: {len(obs)} observations for {len(reward)} steps: cut short?")
    obs, action, reward = (a.astype(np.float32, copy=False) for a in (obs, action, reward))
    check_finite(where, {"terminations": terminated, "truncations": truncated})
    terminated, truncated = terminated != 0, truncated != 0
    truncated[-1:] |= ~terminated[-1:]
    return Transitions(obs[:-1], action, reward, obs[1:], terminated, truncated & ~terminated)
