"""Read files of arrays and tables, and the errors that a damaged one raises; write tables."""

from pathlib import Path
from typing import Any, BinaryIO

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from tom.data.unpack import DAMAGE, read_arrays, read_columns

__all__ = ["DAMAGE", "read_arrays", "read_table", "write_table"]


def read_table(path: Path) -> pd.DataFrame:
    """The columns of a Parquet file. Raises one of DAMAGE."""
    # Not by pandas: it would read hive partitions from the folder's name, and its conversion from
    # Arrow takes twice as long, which matters in a store of 200 runs.
    read = read_columns(path)
    return pd.DataFrame({name: read[name].to_numpy() for name in read.column_names})


def write_table(where: Path | BinaryIO, table: pa.Table, **more: Any) -> None:
    """Write a Parquet file, compressed, with checksums by which a reader finds a changed bit."""
    pq.write_table(table, where, compression="zstd", write_page_checksum=True, **more)


NUMBERS = {"use_dictionary": False, "use_byte_stream_split": True}
"""how columns of floating-point numbers are written; other types are refused with it"""
