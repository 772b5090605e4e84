"""Reads files of arrays and tables; what reading a damaged one raises."""

import zipfile
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

DAMAGE = (
    OSError,
    ValueError,  # also what numpy and JSON raise
    KeyError,
    TypeError,
    EOFError,
    OverflowError,  # a number beyond every array's
    NotImplementedError,  # zipfile, for a method it does not know
    zipfile.BadZipFile,
    pa.ArrowException,
)
"""what reading a damaged file may raise"""


def read_table(path: Path) -> pd.DataFrame:
    """The columns of a Parquet file. Raises one of DAMAGE."""
    # One file by its own name: pandas would take hive partitions out of the folder's name. Its own
    # way from Arrow to a frame takes twice as long, which a store of 200 runs notices.
    read = pq.ParquetFile(path).read(use_threads=False)
    return pd.DataFrame({name: read[name].to_numpy() for name in read.column_names})


def read_arrays(path: Path) -> dict[str, NDArray]:
    """The arrays of an `.npz` file by name, loaded without pickle. Raises one of DAMAGE."""
    with np.load(path, allow_pickle=False) as file:
        return {name: file[name] for name in file.files}
