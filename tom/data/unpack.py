"""Files of others, which may be damaged or made to harm: judged by what they declare.

Nothing here allocates what a file says it holds. A header that promises more than the file has, and
a small file that inflates to what no run can have, raise ValueError before anything is made of it.
"""

import lzma
import math
import os
import stat
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Callable, Iterator
from io import BufferedReader
from pathlib import Path
from typing import IO

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch
from numpy.typing import NDArray

DAMAGE = (
    OSError,
    ValueError,  # also what numpy and JSON raise
    LookupError,
    TypeError,
    EOFError,
    OverflowError,  # a number beyond every array's
    SyntaxError,
    tokenize.TokenError,  # numpy's header is Python's
    RuntimeError,  # zipfile, for what is encrypted; with NotImplementedError and RecursionError
    MemoryError,
    struct.error,
    zlib.error,
    lzma.LZMAError,
    zipfile.BadZipFile,
    pa.ArrowException,
)
"""what reading a damaged file may raise"""

MOST = 256 * 2**20
"""bytes that a file of no particular run may unpack to"""

_HEADERS = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}
NUMBERS = {"BOOLEAN", "INT32", "INT64", "FLOAT", "DOUBLE"}
"""Parquet's physical types of a fixed width"""

BATCH_ROWS = 65_536


def open_file(path: Path) -> BufferedReader:
    """Open `path` for reading. Raises OSError, or ValueError for what is no file.

    A pipe in its place would hold up whoever opens it for good.
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
    """The arrays of an `.npz` file by name, at most `most` bytes, loaded without pickle.

    Those whose names are `wanted`. Raises one of DAMAGE.
    """
    with open_file(path) as file:
        check_arrays(file, most)
        with np.load(file, allow_pickle=False) as found:
            return {name: found[name] for name in found.files if wanted(name)}


def check_arrays(file: IO[bytes], most: int = MOST) -> None:
    """Raises ValueError unless every array of an `.npz` file is as long as its header says.

    `most` bytes may all of them be. A damaged archive raises others of DAMAGE.
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


def read_batches(table: pq.ParquetFile, most: int = MOST) -> pa.Table:
    """A Parquet file's columns, which must be numbers, and `most` bytes of them at most.

    Read in batches: what its footer says of its length need not be so. Raises one of DAMAGE.
    """
    # The schema's columns, not the footer's: at those Arrow takes a process down where they differ.
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


def check_tensors(file: IO[bytes]) -> None:
    """Raises ValueError unless a file of torch's holds its tensors as they are, not packed.

    So it allocates no more than its own length. Raises zipfile's errors where it is none.
    """
    with zipfile.ZipFile(file) as archive:
        members = archive.infolist()
    if any(member.compress_type != zipfile.ZIP_STORED for member in members):
        raise ValueError("its parts are packed, which torch never does")
    if sum(member.file_size for member in members) > file.seek(0, os.SEEK_END):
        raise ValueError("its parts are larger than the file")
    file.seek(0)


def check_views(state: object) -> None:
    """Raises ValueError where a loaded tensor has more elements than memory of its own."""
    for tensor in _tensors(state, set()):
        whole = tensor.layout is torch.strided and not tensor.is_meta and not tensor.is_quantized
        held = tensor.untyped_storage().nbytes() if whole else -1
        if tensor.numel() * tensor.element_size() > held:
            raise ValueError(f"a tensor of {tuple(tensor.shape)} is larger than what it holds")


def _tensors(value: object, seen: set[int]) -> Iterator[torch.Tensor]:
    """Every tensor in nested containers, each container once: they may hold one another."""
    waiting = [value]
    while waiting:
        one = waiting.pop()
        if isinstance(one, torch.Tensor):
            yield one
        elif isinstance(one, dict | list | tuple | set) and id(one) not in seen:
            seen.add(id(one))
            waiting.extend(one.values() if isinstance(one, dict) else one)


def _declared(stream: IO[bytes]) -> int:
    """The length of an `.npy` file by its header."""
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
