"""Read files of arrays and tables, and the errors that a damaged one raises."""

from pathlib import Path

import pandas as pd

from tom.data.unpack import DAMAGE, MOST, open_file, read_arrays, read_columns

__all__ = ["DAMAGE", "read_arrays", "read_table"]


def read_table(path: Path, most: int = MOST) -> pd.DataFrame:
    """The columns of a Parquet file, at most `most` bytes. Raises one of DAMAGE."""
    # Not by pandas: it would read hive partitions from the folder's name, and its conversion from
    # Arrow takes twice as long, which matters in a store of 200 runs.
    with open_file(path) as file:
        read = read_columns(file, most)
    return pd.DataFrame({name: read[name].to_numpy() for name in read.column_names})
