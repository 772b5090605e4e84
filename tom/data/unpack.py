"""Read files of arrays and columns that may be damaged, without executing code."""

import errno
import lzma
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

DAMAGE = (
    OSError,
    ValueError,  # numpy and JSON raise it too
    LookupError,
    TypeError,
    EOFError,
    OverflowError,  # a number too large for an array
    SyntaxError,
    tokenize.TokenError,  # numpy's header is a Python literal
    RuntimeError,  # encrypted zip files; includes NotImplementedError and RecursionError
    struct.error,
    zlib.error,
    lzma.LZMAError,
    zipfile.BadZipFile,
    pa.ArrowException,
)
"""errors that reading a damaged file may raise"""

_FOR_NOW = (
    errno.EIO, errno.EACCES, errno.EPERM, errno.ESTALE, errno.ETIMEDOUT, errno.ENOTCONN,
    errno.ENODEV, errno.ENXIO, errno.EREMOTEIO, errno.EHOSTDOWN, errno.EMFILE, errno.ENFILE,
)  # fmt: skip

NUMBERS = {"BOOLEAN", "INT32", "INT64", "FLOAT", "DOUBLE", "FIXED_LEN_BYTE_ARRAY"}
"""Parquet's physical types of a fixed width; the last is that of half precision and of decimals"""


def cannot_read_now(error: BaseException) -> bool:
    """Whether the error says nothing of a file's content: a disk or a right was lacking."""
    return isinstance(error, OSError) and error.errno in _FOR_NOW


def read_arrays(
    path: Path, wanted: Callable[[str], bool] = lambda name: True
) -> dict[str, NDArray]:
    """The arrays of an `.npz` file whose names are `wanted`, loaded without pickle.

    Raises one of DAMAGE.
    """
    with np.load(path, allow_pickle=False) as archive:
        return {name: archive[name] for name in archive.files if wanted(name)}


def read_columns(
    file: Path | BinaryIO, wanted: Callable[[str], bool] = lambda name: True
) -> tuple[pa.Table, list[str]]:
    """The `wanted` columns of a Parquet file, which must be numeric, and the names of all.

    Raises one of DAMAGE. Without Arrow's threads: one that is alive when the process exits may
    abort it, after everything was done (github.com/apache/arrow/issues/34314).
    """
    table = pq.ParquetFile(file, page_checksum_verification=True, pre_buffer=False)
    # The schema's columns, not the footer's: if the two differ, Arrow crashes the process.
    schema = table.schema
    names = table.schema_arrow.names
    chosen = [name for name in names if wanted(name)]
    for column in map(schema.column, range(len(schema))):
        top = column.path if column.path in names else column.path.partition(".")[0]
        if top in chosen and column.physical_type not in NUMBERS:
            raise ValueError(
                f"column '{top}' holds {column.physical_type.lower()}, where numbers belong"
            )
    return table.read(columns=chosen, use_threads=False), names
