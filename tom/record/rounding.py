"""Numbers with fewer digits, which compress well: what a small copy of a run holds."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from tom.record.files import plain

DIGITS = 5
MANTISSA_BITS = 10  # of float32's 23, and all that float16 has: an error of 0.05 % at most


def short(value: Any) -> Any:
    """A number in JSON's types, with DIGITS digits; anything else as it is."""
    number = plain(value)
    return float(f"{number:.{DIGITS}g}") if isinstance(number, float) else number


def coarse(array: NDArray) -> NDArray:
    """Floats rounded to MANTISSA_BITS as float32; the rest as it is."""
    if not np.issubdtype(array.dtype, np.floating):
        return array
    single = np.array(array, np.float32, order="C")
    cut = 23 - MANTISSA_BITS
    bits = single.view(np.uint32).astype(np.uint64) + (1 << (cut - 1))  # round, not truncate
    rounded = ((bits >> cut) << cut).astype(np.uint32).view(np.float32)
    return np.where(np.isfinite(single), rounded, single)


def half(array: NDArray) -> NDArray:
    """Floats as float16 where all of them fit its range, else `coarse`; the rest as it is.

    Next to zero (below 6e-5) the error is 3e-8 at most, not 0.05 %.
    """
    if not np.issubdtype(array.dtype, np.floating):
        return array
    largest = np.abs(array, where=np.isfinite(array), out=np.zeros_like(array)).max(initial=0)
    return array.astype(np.float16) if largest <= np.finfo(np.float16).max else coarse(array)
