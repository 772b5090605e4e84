"""Recorded experience of other programs as transitions (docs/your-own.md).

A file of columns (`.npz`, Parquet, D4RL's HDF5) has one row for each transition, in the order of
collection; a Minari folder has episodes. All of it is untrusted: nothing is unpickled, and HDF5 may
not lead to other files of this machine.
"""

import json
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.dataset
from numpy.typing import NDArray

from tom.data.card import UNORDERED, Card, make_card, successive
from tom.data.transitions import BEHAVIOUR, Transitions
from tom.data.unpack import DAMAGE, read_columns
from tom.errors import UserError, reason
from tom.machine.memory import is_out_of_memory

FORMATS = "an .npz or Parquet file of transitions, a D4RL file (.hdf5) or a Minari folder"
AXES = {"obs": 2, "action": 2, "reward": 1, "next_obs": 2, "terminated": 1, "truncated": 1}
"""the columns, with their number of axes"""
VERSION = "policy_version"
"""one column more, if it is there: which policy collected the row"""
ALIASES = {
    "observations": "obs",
    "actions": "action",
    "rewards": "reward",
    "next_observations": "next_obs",
    "terminals": "terminated",
    "terminations": "terminated",
    "timeouts": "truncated",
    "truncations": "truncated",
}
"""D4RL's and Minari's names of them"""
EPISODE = ("observations", "actions", "rewards", "terminations", "truncations")
"""the arrays of a Minari episode: one observation more than steps"""
_PICKLES = (".pkl", ".pickle", ".zip", ".pt", ".pth")
_MINARI_ID = re.compile(r"[\w-]+(/[\w-]+)*-v\d+")
_NUMBERED = re.compile(r"(.+)_(\d+)")

Columns = dict[str, NDArray]


@dataclass(frozen=True)
class Recording:
    """The transitions of a dataset, in the order of collection, and their card.

    An episode whose recording stops without a terminal state is marked as truncated, so that a row
    after a terminated or truncated one always starts an episode. Numbers have the precision of the
    file, actions the recorded task's own units. `policy_version` (N,) and `behaviour` (N, 2 A, the
    columns of BEHAVIOUR) are None if they are not known.
    """

    rows: Transitions
    card: Card
    policy_version: NDArray[np.int64] | None = None
    behaviour: NDArray[np.float32] | None = None


def read_dataset(path: str | Path) -> Recording:
    """The content of a dataset (FORMATS). Raises UserError."""
    path = Path(path)
    if path.parent.name == "buffer" and (path.absolute().parents[1] / "config.json").is_file():
        run = path.absolute().parents[1]
        raise UserError(f"{path} is a part of the run {run.name}, in its units: name the run")
    try:
        return _assembled(path, _columns_of(path))
    except DAMAGE as error:
        if is_out_of_memory(error):
            raise
        raise UserError(
            f"{path} cannot be read ({reason(error)}): write it again, or download it again"
        ) from error


def where_else(name: str) -> str:
    """What to give in place of `name`, where there is nothing."""
    if not _MINARI_ID.fullmatch(name):
        return f"give {FORMATS}"
    return (
        f"if it is a Minari id, `minari download {name}` and give the folder "
        f"~/.minari/datasets/{name}"
    )


def initial_obs(transitions: Transitions) -> np.ndarray:
    """The first observation of every episode, (M0, O): draws of the start distribution mu_0.

    An episode starts at the first row and after every terminated or truncated one.
    """
    t = transitions.numpy()
    starts = np.append(True, t.ended()[:-1])
    return np.asarray(t.obs)[starts]


def _columns_of(path: Path) -> Columns:
    if path.is_dir():
        return _minari(path)
    if path.suffix == ".npz":
        with np.load(path, allow_pickle=False) as archive:
            names = archive.files
            arrays = {name: archive[name] for name in filter(_is_wanted, names)}
    elif path.suffix == ".parquet":
        arrays, names = _parquet(path)
    elif path.suffix in (".hdf5", ".h5", ".hdf"):
        with h5py.File(path, "r") as file:
            names = list(map(str, file))
            arrays = {name: _stored(file, name) for name in filter(_is_wanted, names)}
    elif path.suffix in _PICKLES:
        raise UserError(
            f"{path} may hold pickles, which are code and are not loaded: export the transitions "
            "to .npz (for stable-baselines3: tom.integrations.sb3.export_buffer)"
        )
    else:
        raise UserError(f"{path} is of a kind that cannot be read here: give {FORMATS}")
    return _checked(path, arrays, names)


def _is_wanted(name: str) -> bool:
    return ALIASES.get(name, name) in (*AXES, VERSION, *BEHAVIOUR)


def _parquet(path: Path) -> tuple[Columns, list[str]]:
    """The columns, and the names of all.

    Vectors are lists of equal length in a column, or numbered columns: `obs_0`, `obs_1`, ...
    """
    table, names = read_columns(path, lambda name: _is_wanted(_NUMBERED.sub(r"\1", name)))
    columns: Columns = {}
    numbered: dict[str, dict[int, NDArray]] = {}
    for name in table.column_names:
        match = _NUMBERED.fullmatch(name)
        if match and not _is_wanted(name):
            numbered.setdefault(match[1], {})[int(match[2])] = _arrow(table, name)
        else:
            columns[name] = _arrow(table, name)
    for name, parts in numbered.items():
        if sorted(parts) != list(range(len(parts))):
            raise UserError(f"{path}: columns {name}_... are not numbered from 0 without a gap")
        columns[name] = np.stack([parts[i] for i in range(len(parts))], 1)
    return columns, names


def _arrow(table: pa.Table, name: str) -> NDArray:
    """A column of numbers (N,), or of lists of equal length (N, D)."""
    stored = table[name].combine_chunks()
    if stored.null_count:
        raise ValueError(f"column '{name}' has {stored.null_count} rows without a value")
    if isinstance(stored, pa.ListArray | pa.LargeListArray | pa.FixedSizeListArray):
        inner = stored.flatten()
        width = len(inner) // max(len(stored), 1)
        fixed = isinstance(stored, pa.FixedSizeListArray)
        if not fixed and (np.diff(stored.offsets.to_numpy()) != width).any():
            raise ValueError(f"the lists of column '{name}' differ in length")
        return np.array(inner.to_numpy(zero_copy_only=False)).reshape(len(stored), width)
    if pa.types.is_decimal(stored.type):
        stored = stored.cast(pa.float64())
    return np.array(stored.to_numpy(zero_copy_only=False))


def _member(group: h5py.Group, name: str, kind: type[Any]) -> Any:
    """A member of a group, from the file itself: a link may lead to any file of this machine."""
    where = f"'{name}' in {group.file.filename}:{group.name}"
    if not isinstance(group.get(name, getlink=True), h5py.HardLink):
        raise UserError(f"{where} is a link: only data within the file is read")
    stored = group[name]
    if not isinstance(stored, kind):
        raise UserError(f"{where} is no {kind.__name__.lower()}: only flat observations and "
                        "actions are read, in episodes")  # fmt: skip
    return stored


def _stored(group: h5py.Group, name: str) -> NDArray:
    stored = _member(group, name, h5py.Dataset)
    if stored.external or stored.is_virtual:  # either could read any file on this machine
        where = f"'{name}' in {group.file.filename}:{group.name}"
        raise UserError(f"{where} is in another file: only data within the file is read")
    return np.asarray(stored[()])


def _minari(path: Path) -> Columns:
    """A Minari dataset (the folder with `data/`, or `data/` itself), without its package."""
    folder = path / "data" if (path / "data").is_dir() else path
    about, archive = folder / "metadata.json", folder / "main_data.hdf5"
    if about.is_file():
        form = json.loads(about.read_text()).get("data_format", "hdf5")
    elif archive.is_file():
        form = "hdf5"  # Minari before 0.5 kept its metadata inside this file
    else:
        raise UserError(f"{folder} is not a Minari dataset: no metadata.json or main_data.hdf5")
    if form not in ("hdf5", "arrow", "parquet"):
        raise UserError(f"{about}: data format '{form}' is not known: hdf5, arrow, parquet")
    given = _hdf5_episodes(archive) if form == "hdf5" else _arrow_episodes(folder, form)
    episodes = [_episode(where, arrays) for where, arrays in given]
    if not episodes:
        raise UserError(f"{path} holds no episodes: record or download the dataset again")
    return {name: np.concatenate([episode[name] for episode in episodes]) for name in AXES}


def _hdf5_episodes(archive: Path) -> Iterator[tuple[str, Columns]]:
    with h5py.File(archive, "r") as file:
        for name in sorted((n for n in map(str, file) if n.startswith("episode_")), key=_number):
            group = _member(file, name, h5py.Group)
            yield f"{archive}: {name}", {field: _stored(group, field) for field in EPISODE}


def _arrow_episodes(folder: Path, form: str) -> Iterator[tuple[str, Columns]]:
    names = [f.name for f in folder.iterdir() if f.is_dir() and f.name.isdecimal()]
    for name in sorted(names, key=_number):
        table = pyarrow.dataset.dataset(
            folder / name, format=form, ignore_prefixes=["_", ".", "metadata.json"]
        ).to_table()
        # All columns are as long as the observations: the last row of the others is padding.
        steps = table.slice(0, max(len(table) - 1, 0))
        arrays = {field: _arrow(steps, field) for field in EPISODE[1:]}
        yield str(folder / name), {"observations": _arrow(table, "observations"), **arrays}


def _number(name: str) -> int:
    return int(name.removeprefix("episode_"))


def _episode(where: str, arrays: Columns) -> Columns:
    """One episode of T steps from its T + 1 observations."""
    columns = {ALIASES[name]: _numbers(where, ALIASES[name], a) for name, a in arrays.items()}
    obs = columns.pop("obs")
    if {len(column) for column in columns.values()} != {len(obs) - 1}:
        raise UserError(
            f"{where}: {len(obs)} observations for {len(columns['reward'])} steps: cut short? "
            "Download it again"
        )
    truncated = columns["truncated"].astype(bool)
    truncated[-1:] |= ~columns["terminated"][-1:].astype(bool)
    return {**columns, "truncated": truncated, "obs": obs[:-1], "next_obs": obs[1:]}


def _checked(path: Path, given: Columns, names: Iterable[str]) -> Columns:
    """The columns by our names, of equal length; `next_obs` or `truncated` may be missing.

    `names` are those of all columns of the file.
    """
    columns: Columns = {}
    for name, values in given.items():
        known = ALIASES.get(name, name)
        if known in columns:
            raise UserError(f"{path} has '{known}' twice, once as '{name}': keep one of them")
        columns[known] = _numbers(path, name, values)
    missing = [n for n in AXES if n not in columns and n not in ("next_obs", "truncated")]
    if "next_obs" not in columns and "truncated" not in columns:
        missing.append("next_obs or truncated")
    if missing:
        advice = f"its columns are to be {', '.join(AXES)}"
        if "observations_0" in names:
            advice = f"d3rlpy keeps its episodes apart: write one row a step with savez, {advice}"
        elif {*names} & {"dones", "done"}:
            advice = (
                "'dones' does not tell a terminal state from a time limit: write 'terminated', 1 "
                "where the task ended, and 'truncated', 1 where only the recording did"
            )
        has = ", ".join(names) or "nothing"
        raise UserError(f"{path} lacks {', '.join(missing)} (it has {has}): {advice}")
    lengths = {name: len(values) for name, values in columns.items()}
    if len(set(lengths.values())) > 1:
        counts = ", ".join(f"{name} {length}" for name, length in lengths.items())
        raise UserError(f"{path}: columns differ in their number of rows ({counts})")
    if not lengths["obs"]:
        raise UserError(f"{path} holds no rows: record some transitions")
    if "next_obs" in columns and columns["next_obs"].shape != columns["obs"].shape:
        widths = columns["next_obs"].shape[1], columns["obs"].shape[1]
        raise UserError(f"{path}: 'next_obs' has {widths[0]} dimensions, 'obs' has {widths[1]}")
    return columns


def _numbers(where: str | Path, name: str, values: NDArray) -> NDArray:
    """A column of numbers in its own precision; a trailing axis of length one may be dropped."""
    axes = 2 if name in BEHAVIOUR else AXES.get(ALIASES.get(name, name), 1)
    if axes == 1 and values.ndim == 2 and values.shape[1] == 1:
        values = values[:, 0]
    if values.ndim != axes or values.dtype.kind not in "biuf":
        wanted = "(N,)" if axes == 1 else "(N, D)"
        raise UserError(
            f"{where}: '{name}' is {values.dtype} of shape {values.shape}, not numbers of shape "
            f"{wanted}: only flat observations and actions are read, a row for each transition"
        )
    kept = values.dtype.kind == "f" and values.dtype.itemsize <= 8
    return values.astype(values.dtype.newbyteorder("=") if kept else np.float64, copy=False)


def _assembled(path: Path, columns: Columns) -> Recording:
    """Columns of N > 0 rows as a recording.

    Without `truncated` an episode ends where the next row's obs is not this row's next_obs, unless
    rows seem to be in no order at all. Without `next_obs` the observation of the next row is used,
    but never across episodes: the last row of each episode is dropped, and the row before it is
    marked as truncated.
    """
    for name, values in columns.items():
        if name not in BEHAVIOUR:  # NaN where nobody knows
            _check_values(path, name, values)
    obs, action, reward, flag = (columns[n] for n in ("obs", "action", "reward", "terminated"))
    terminated, next_obs = flag != 0, columns.get("next_obs")
    version = columns[VERSION].astype(np.int64) if VERSION in columns else None
    behaviour = _behaviour(path, columns)
    if "truncated" in columns:
        cut = columns["truncated"] != 0
    else:
        assert next_obs is not None
        cut = np.append(~successive(obs, next_obs), True) & ~terminated
        if cut.sum() > max(UNORDERED * len(obs), 1):
            cut[:] = False
    if next_obs is not None:
        raw = Transitions(obs, action, reward, next_obs, terminated, cut)
        resolved = cut & ~terminated
        resolved[-1] = not terminated[-1]
        return Recording(replace(raw, truncated=resolved), make_card(raw), version, behaviour)
    ends = terminated | cut
    ends[-1] = True
    kept = np.flatnonzero(~ends)
    if not len(kept):
        raise UserError(
            f"{path} has no 'next_obs', and every row of it is the last one of an episode, which "
            "has no successor: record 'next_obs' too, or longer episodes"
        )
    never = np.zeros(len(kept), bool)
    rows = Transitions(obs[kept], action[kept], reward[kept], obs[kept + 1], never, ends[kept + 1])
    card = replace(make_card(rows, ordered=False), lost=int(terminated.sum()))
    version = None if version is None else version[kept]
    return Recording(rows, card, version, None if behaviour is None else behaviour[kept])


def _behaviour(path: Path, columns: Columns) -> NDArray[np.float32] | None:
    """The columns of BEHAVIOUR side by side, (N, 2 A). Raises UserError if they are not whole."""
    parts = [columns[name] for name in BEHAVIOUR if name in columns]
    if not parts:
        return None
    if len(parts) == 1 or any(part.shape != columns["action"].shape for part in parts):
        raise UserError(
            f"{path}: {' and '.join(BEHAVIOUR)} must both be there, each of the shape of 'action' "
            f"{columns['action'].shape}: the mean and the log standard deviation before tanh"
        )
    return np.concatenate(parts, 1).astype(np.float32)


def _check_values(path: Path, name: str, values: NDArray) -> None:
    """Raises UserError for numbers beyond single precision, and flags other than 0 and 1."""
    with np.errstate(over="ignore"):
        finite = np.isfinite(values.astype(np.float32, copy=False))
    wrong = np.flatnonzero(~finite.reshape(len(values), -1).all(1))
    if len(wrong):
        raise UserError(
            f"{path}: '{name}' is not finite in {len(wrong)} rows, first in row {wrong[0]}: "
            "leave out the episodes that hold them"
        )
    if name in ("terminated", "truncated"):
        strange = np.flatnonzero((values != 0) & (values != 1))
        if len(strange):
            raise UserError(
                f"{path}: '{name}' is {values[strange[0]]:g} in row {strange[0]}, and other than 0 "
                f"and 1 in {len(strange)} rows: write 1 where it holds, 0 elsewhere"
            )
