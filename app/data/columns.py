"""The quantities of a buffer's rows as 16-bit codes: what the browser draws and filters.

Browser and server choose rows by the same codes with the same arithmetic (app/parts/map/rows.js),
so that both choose the same rows.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from app.data import buffer
from app.data.buffer import Floats
from app.data.cache import cached
from tom.envs import ROAD
from tom.record.reader import RunReader
from tom.spread import spread

Codes = NDArray[np.uint16]

TOP, UNKNOWN = 65534, 65535
OCTAVES = 16.0
"""weights are coded from 2^-16 to 2^16 times the mean"""
TAILS = 0.0005
"""share of the rows at each end of a quantity whose codes are those of the ends"""
RANGE_ROWS = 100_000
"""rows from which the ends are estimated"""


@dataclass(frozen=True)
class Column:
    """A quantity of every recorded row; code c means low + c / TOP (high - low)."""

    name: str
    low: float
    high: float


def encode(values: NDArray, column: Column) -> Codes:
    """Values (N,) as codes; NaN is UNKNOWN."""
    known = np.isfinite(values)
    span = column.high - column.low or 1.0
    share = (np.asarray(values, np.float64) - column.low) / span
    codes = np.rint(np.clip(np.where(known, share, 0.0), 0, 1) * TOP).astype(np.uint16)
    return np.where(known, codes, np.uint16(UNKNOWN)).astype(np.uint16)


def decode(codes: NDArray, column: Column) -> Floats:
    """The values that codes stand for; UNKNOWN has none."""
    return column.low + codes.astype(np.float64) / TOP * (column.high - column.low)


def weight_codes(weight: NDArray) -> Codes:
    """Weights (N,) relative to their mean on a log axis; code 0 is exactly zero."""
    weight = np.asarray(weight, np.float64)
    mean = weight.mean() if len(weight) else 1.0
    with np.errstate(divide="ignore"):
        octave = np.log2(weight / (mean if mean > 0 else 1.0))
    codes = 1 + np.rint((np.clip(octave, -OCTAVES, OCTAVES) + OCTAVES) / (2 * OCTAVES) * (TOP - 1))
    return np.where(weight > 0, codes, 0).astype(np.uint16)


def rank_codes(codes: Codes) -> Codes:
    """By weight codes (N,): the share of the rows that weigh no more, in %."""
    below = np.cumsum(np.bincount(codes, minlength=UNKNOWN + 1))
    shares = -(-(below - 1).clip(0) * TOP // max(len(codes), 1))  # rounded up
    return shares[codes].astype(np.uint16)


def bounds(column: Column, low: float | None, high: float | None) -> tuple[int, int]:
    """The codes from the first to the last of an interval; None is an open end."""
    if column.name == WEIGHT.name:
        first = 0 if low is None else _weight_code(low, up=True)
        return first, TOP if high is None else _weight_code(high, up=False)
    span = column.high - column.low
    if span <= 0:  # a constant
        within = (low is None or low <= column.low) and (high is None or column.low <= high)
        return (0, UNKNOWN) if within else (1, 0)
    first = 0 if low is None else int(np.ceil((low - column.low) / span * TOP - 1e-6))
    last = TOP if high is None else int(np.floor((high - column.low) / span * TOP + 1e-6))
    return max(first, 0), min(last, TOP)


def _weight_code(weight: float, *, up: bool) -> int:
    if weight <= 0:
        return 0
    code = 1 + (np.log2(weight) + OCTAVES) / (2 * OCTAVES) * (TOP - 1)
    return int(np.ceil(code - 1e-6)) if up else int(np.floor(code + 1e-6))


AGE, RANK, WEIGHT = (
    Column("age", 0.0, 100.0),
    Column("weight rank", 0.0, 100.0),
    Column("weight", 0.0, 1.0),
)
"""quantities of a fit, in %, % and times the mean"""
DISTANCE = Column("policy distance", 0.0, 2.0)
"""quantity of a fit whose policy is known: no action in [-1, 1] lies farther from another one"""
REWARD, RETURN, VERSION = "reward", "return of the episode", "policy version"
ERROR = "model error"
ROW_QUANTITIES = REWARD, RETURN, VERSION, ERROR
"""quantities of the record that are no dimension of the task"""
ERROR_ROWS = 100_000
"""maximum number of rows of known model error"""
RANGE_ERROR_ROWS = 2000
"""of them, those from which the ends are estimated"""


def values(run: RunReader, name: str) -> NDArray:
    """A quantity (N,) of all recorded rows of a run; NaN where it is not known.

    Most are views of the rows, which would take their room in the cache twice.
    """
    rows = buffer.recorded(run).rows.numpy()
    if name == REWARD:
        return np.asarray(rows.reward)
    if name == RETURN:
        return buffer.row_episodes(run)[2]
    if name == VERSION:
        return buffer.recorded(run).version
    if name == ERROR:
        return buffer.model_errors_of(run, spread(len(rows), ERROR_ROWS))
    names, actions = buffer.obs_and_action_names(run)
    if name in names:
        return np.asarray(rows.obs)[:, names.index(name)]
    return np.asarray(rows.action)[:, actions.index(name)]


@cached("buffer", "model")
def recorded(run: RunReader) -> tuple[Column, ...]:
    """The quantities of the record, those of the task's dimensions last."""
    rows = buffer.recorded(run).rows.numpy()
    names, actions = buffer.obs_and_action_names(run)
    known = [REWARD, RETURN]
    known += [VERSION] if buffer.policies_known(buffer.recorded(run).version) else []
    known += [ERROR] if run.env != ROAD and buffer.has_model(run) else []
    found = []
    for name in [*known, *names, *actions]:
        if name == ERROR:
            part = buffer.model_errors_of(run, spread(len(rows), RANGE_ERROR_ROWS))
        else:
            part = values(run, name)[spread(len(rows), RANGE_ROWS)]
        part = part[np.isfinite(part)]
        low, high = np.quantile(part, [TAILS, 1 - TAILS]) if len(part) else (0.0, 0.0)
        found.append(Column(name, float(low), float(high)))
    return tuple(found)


@cached("buffer", "model")
def codes(run: RunReader, name: str) -> Codes:
    """The codes (N,) of a quantity of the record."""
    column = next(one for one in recorded(run) if one.name == name)
    return encode(values(run, name), column)
