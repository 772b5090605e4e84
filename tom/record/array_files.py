"""Reads files of arrays and tables; what reading a damaged one raises."""

from pathlib import Path

import pandas as pd
import pyarrow.parquet as pq

from tom.data.unpack import DAMAGE, MOST, open_file, read_arrays, read_batches

__all__ = ["DAMAGE", "read_arrays", "read_table"]


def read_table(path: Path, most: int = MOST) -> pd.DataFrame:
    """The columns of a Parquet file, at most `most` bytes of them. Raises one of DAMAGE."""
    # One file by its own name: pandas would take hive partitions out of the folder's name. Its own
    # way from Arrow to a frame takes twice as long, which a store of 200 runs notices.
    with open_file(path) as file:
        read = read_batches(pq.ParquetFile(file, page_checksum_verification=True), most)
    return pd.DataFrame({name: read[name].to_numpy() for name in read.column_names})
