"""A finished case on disk, written atomically and read without executing code from the file."""

import _codecs
import pickle
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, get_args, get_type_hints

import numpy as np
import torch
from numpy.dtypes import Float32DType, Float64DType, Int64DType

from tom.data.tensor_files import check_tensors
from tom.data.unpack import DAMAGE, open_file
from tom.record.files import replace

# Types needed to load arrays; all others are primitives or the outcome's own classes.
ARRAYS: tuple[Any, ...] = (
    np.ndarray,
    np.dtype,
    np.ndarray.__reduce__(np.zeros(0))[0],
    np.float64.__reduce__(np.float64())[0],
    Float32DType,
    Float64DType,
    Int64DType,
    _codecs.encode,
)


def save(outcome: object, path: Path) -> None:
    """Write an outcome: a dataclass of primitives, arrays and other dataclasses."""
    replace(path, lambda file: torch.save(outcome, file), sync=True)


def load(path: Path, kind: type) -> Any:
    """The outcome of type `kind` at `path`; None if it cannot be read."""
    try:
        with open_file(path) as file, torch.serialization.safe_globals([*ARRAYS, *classes(kind)]):
            check_tensors(file)
            return torch.load(file, weights_only=True)
    except (*DAMAGE, pickle.UnpicklingError):
        return None


def classes(kind: Any) -> Iterator[type]:
    """The dataclass `kind` and those among its fields, at any depth."""
    for part in get_args(kind):
        yield from classes(part)
    if isinstance(kind, type) and is_dataclass(kind):
        yield kind
        hints = get_type_hints(kind)
        for field in fields(kind):
            yield from classes(hints[field.name])
