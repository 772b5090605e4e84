"""Checks of files that may be damaged or malicious, before their content is loaded.

Nothing here trusts a file's own sizes. A header that declares more than the file holds, or a small
file that inflates to more than a run can have, raises ValueError before memory is allocated.
"""

import errno
import lzma
import math
import os
import stat
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Callable
from io import BufferedReader
from pathlib import Path
from typing import IO, BinaryIO

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from tom.machine.memory import ran_out

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
    MemoryError,
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

MOST = 256 * 2**20
"""bytes that a file may unpack to if no run sets a bound"""

_HEADERS = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}
NUMBERS = {"BOOLEAN", "INT32", "INT64", "FLOAT", "DOUBLE"}
"""Parquet's physical types of a fixed width"""

BATCH_ROWS = 65_536


def cannot_read_now(error: BaseException) -> bool:
    """Whether the error says nothing of a file's content: a disk, a right or memory was lacking."""
    return ran_out(error) or (isinstance(error, OSError) and error.errno in _FOR_NOW)


def open_file(path: Path) -> BufferedReader:
    """Open `path` for reading. Raises OSError, or ValueError if it is not a regular file.

    Opening a pipe would block for good.
    """
    handle = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    if not stat.S_ISREG(os.fstat(handle).st_mode):
        os.close(handle)
        raise ValueError("it is no file")
    return os.fdopen(handle, "rb")


def read_bytes(path: Path) -> bytes:
    """The content of the file `path`. Raises as `open_file` does."""
    with open_file(path) as file:
        return file.read()


def read_arrays(
    path: Path, most: int = MOST, wanted: Callable[[str], bool] = lambda name: True
) -> dict[str, NDArray]:
    """The arrays of an `.npz` file by name, at most `most` bytes in total, loaded without pickle.

    Only those whose names are `wanted`. Raises one of DAMAGE.
    """
    with open_file(path) as file:
        check_arrays(file, most)
        with np.load(file, allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files if wanted(name)}


def check_arrays(file: IO[bytes], most: int = MOST) -> None:
    """Raises ValueError unless every array of an `.npz` file is as long as its header declares.

    All arrays together may have `most` bytes. A damaged archive raises another of DAMAGE.
    """
    with zipfile.ZipFile(file) as archive:
        members = archive.infolist()
        _check(sum(member.file_size for member in members), most)
        for member in members:
            with archive.open(member) as stream:
                declared = _declared(stream)
                if declared != member.file_size:
                    raise ValueError(
                        f"{member.filename} declares {declared} bytes and holds {member.file_size}"
                    )
    file.seek(0)


def read_columns(file: BinaryIO, most: int = MOST) -> pa.Table:
    """The columns of a Parquet file, which must be numeric and have at most `most` bytes.

    Read in batches, because the length in the footer may be wrong, and without Arrow's threads:
    one that is alive when the process exits may abort it, after everything was done
    (github.com/apache/arrow/issues/34314). Raises one of DAMAGE.
    """
    table = pq.ParquetFile(file, page_checksum_verification=True, pre_buffer=False)
    # The schema's columns, not the footer's: if the two differ, Arrow crashes the process.
    schema = table.schema
    strange = {schema.column(i).physical_type for i in range(len(schema))} - NUMBERS
    if strange:
        raise ValueError(f"it has columns of {min(strange).lower()}, where numbers belong")
    batches: list[pa.RecordBatch] = []
    size = 0
    for batch in table.iter_batches(BATCH_ROWS, use_threads=False):
        size += batch.nbytes
        _check(size, most)
        batches.append(batch)
    return pa.Table.from_batches(batches, table.schema_arrow)


def _declared(stream: IO[bytes]) -> int:
    """The length of an `.npy` file that its header declares."""
    read = _HEADERS.get(np.lib.format.read_magic(stream))
    if read is None:
        raise ValueError("an array of an unknown format")
    shape, _, dtype = read(stream)
    if dtype.hasobject:
        raise ValueError("an array of objects, which may be code: not read")
    return stream.tell() + math.prod(shape) * dtype.itemsize


def _check(size: int, most: int) -> None:
    if size > most:
        raise ValueError(
            f"it would unpack to {size / 1e9:.1f} GB, and may hold {most / 1e9:.1f} GB at most"
        )
