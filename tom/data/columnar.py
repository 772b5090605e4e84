"""An `.npz` or Parquet file of transitions, in the order of collection (docs/your-own.md).

The columns are `obs` (N, O), `action` (N, A), `reward`, `next_obs` (N, O), `terminated` and
`truncated` (N,). D4RL's and Minari's names of them are known too. Nothing is unpickled.
"""

import re
from pathlib import Path

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from tom.data.recorded import assemble, check_finite
from tom.data.transitions import Transitions
from tom.data.unpack import DAMAGE, read_arrays, read_columns
from tom.errors import UserError, reason

AXES = {"obs": 2, "action": 2, "reward": 1, "next_obs": 2, "terminated": 1, "truncated": 1}
"""the accepted names of each column"""
NEEDED = ("obs", "action", "reward", "terminated")
EITHER = ("next_obs", "truncated")
"""of these, one may be missing"""
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
SUFFIXES = (".npz", ".parquet")
_NUMBERED = re.compile(r"(.+)_(\d+)")

Columns = dict[str, NDArray]


def read_columnar(path: Path) -> Transitions:
    """Read the transitions of a file whose name ends in one of SUFFIXES. Raises UserError."""
    try:
        given = _arrays(path) if path.suffix == ".npz" else _table(path)
    except DAMAGE as error:
        raise UserError(
            f"{path} cannot be read as {path.suffix} ({reason(error)}): write it again"
        ) from error
    columns = {name: _numbers(path, name, given[name]) for name in AXES if name in given}
    _check(path, columns, given)
    next_obs, truncated = (columns.get(name) for name in EITHER)
    obs, action, reward, terminated = (columns[name] for name in NEEDED)
    return assemble(obs, action, reward, terminated, next_obs, truncated)


def _arrays(path: Path) -> Columns:
    columns: Columns = {}
    for name, values in read_arrays(path, _wanted).items():
        _put(path, columns, name, values)
    return columns


def _table(path: Path) -> Columns:
    """Vectors are lists of equal length in a column, or numbered columns: `obs_0`, `obs_1`, ..."""
    table = read_columns(path)
    columns: Columns = {}
    numbered: dict[str, dict[int, NDArray]] = {}
    for name in table.column_names:
        match = _NUMBERED.fullmatch(name)
        if match and _wanted(match[1]):
            numbered.setdefault(match[1], {})[int(match[2])] = _column(table, name)
        elif _wanted(name):
            _put(path, columns, name, _column(table, name))
    for name, parts in numbered.items():
        if sorted(parts) != list(range(len(parts))):
            raise UserError(f"{path}: columns {name}_... are not numbered from 0 without a gap")
        _put(path, columns, name, np.stack([parts[i] for i in range(len(parts))], 1))
    return columns


def _column(table: pa.Table, name: str) -> NDArray:
    stored = table[name].combine_chunks()
    if stored.null_count:
        raise ValueError(f"column '{name}' has {stored.null_count} rows without a value")
    if isinstance(stored, pa.ListArray | pa.LargeListArray | pa.FixedSizeListArray):
        inner = stored.flatten()
        width = len(inner) // max(len(stored), 1)
        fixed = isinstance(stored, pa.FixedSizeListArray)
        if not fixed and (np.diff(stored.offsets.to_numpy()) != width).any():
            raise ValueError(f"the lists of column '{name}' differ in length")
        return inner.to_numpy(zero_copy_only=False).reshape(len(stored), width)
    return stored.to_numpy(zero_copy_only=False)


def _wanted(name: str) -> bool:
    return ALIASES.get(name, name) in AXES


def _put(path: Path, columns: Columns, name: str, values: NDArray) -> None:
    known = ALIASES.get(name, name)
    if known in columns:
        raise UserError(f"{path} has '{known}' twice, once as '{name}': keep one of them")
    columns[known] = values


def _numbers(path: Path, name: str, values: NDArray) -> NDArray[np.float32]:
    """A column as float32; a trailing axis of length one may be dropped."""
    axes = AXES[name]
    if axes == 1 and values.ndim == 2 and values.shape[1] == 1:
        values = values[:, 0]
    if values.ndim != axes or values.dtype.kind not in "biuf":
        wanted = "(N,)" if axes == 1 else f"(N, {'A' if name == 'action' else 'O'})"
        shape = "x".join(map(str, values.shape)) or "one number"
        raise UserError(
            f"{path}: '{name}' is {values.dtype} of shape {shape}, not numbers of shape {wanted}: "
            "flatten each row, and keep a row for each transition"
        )
    with np.errstate(over="ignore"):  # overflow gives infinity, which is reported later
        return values.astype(np.float32, copy=False)


def _check(path: Path, columns: Columns, named: Columns) -> None:
    missing = [name for name in NEEDED if name not in columns]
    if not any(name in columns for name in EITHER):
        missing.append(" or ".join(EITHER))
    if missing:
        has = ", ".join(named) or "none of them"
        raise UserError(
            f"{path} lacks {', '.join(missing)} (it has {has}): its columns are to be "
            + ", ".join(AXES)
        )
    lengths = {name: len(values) for name, values in columns.items()}
    if len(set(lengths.values())) > 1:
        words = ", ".join(f"{name} {length}" for name, length in lengths.items())
        raise UserError(f"{path}: columns differ in their number of rows ({words})")
    if not lengths["obs"]:
        raise UserError(f"{path} holds no rows: record some transitions")
    if "next_obs" in columns and columns["next_obs"].shape != columns["obs"].shape:
        widths = columns["next_obs"].shape[1], columns["obs"].shape[1]
        raise UserError(f"{path}: 'next_obs' has {widths[0]} dimensions, 'obs' has {widths[1]}")
    check_finite(path, columns)
