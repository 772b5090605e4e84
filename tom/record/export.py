"""Export a run to other formats: CSV, Parquet, JSON, TensorBoard events, a Rerun recording.

Everything is made from the run's files and written under a temporary name first.
"""

import os
from collections.abc import Callable, Collection
from contextlib import closing
from dataclasses import asdict
from datetime import datetime
from functools import partial
from math import isnan
from pathlib import Path

import pandas as pd
import pyarrow as pa

from tom.errors import UserError
from tom.harmless import as_csv
from tom.record.decode import write_table
from tom.record.files import replace, replace_json, whole_folder
from tom.record.reader import RunReader
from tom.record.thin import thin


def export(reader: RunReader, kind: str, folder: Path) -> Path:
    """Write the run as `kind` into `folder` and return the path.

    Raises UserError if the export exists already, OSError if it cannot be written.
    """
    suffix, write = EXPORTERS[kind]
    return _written(folder / (reader.run_id + suffix), partial(write, reader))


def export_small(
    reader: RunReader, folder: Path, keep: Collection[str] = (), without: Collection[str] = ()
) -> Path:
    """Write a small copy of the run into `folder`; see `thin`, and `export` for errors."""
    return _written(folder / reader.run_id, lambda path: thin(reader, path, keep, without))


def export_table(table: pd.DataFrame, path: Path) -> Path:
    """Write a table as Parquet; see `export` for errors."""
    return _written(path, partial(_write_frame, table))


def _written(path: Path, write: Callable[[Path], object]) -> Path:
    if os.path.lexists(path):
        raise UserError(f"{path} exists already: move it away or choose another --out")
    path.parent.mkdir(parents=True, exist_ok=True)
    write(path)
    return path


def _write_frame(frame: pd.DataFrame, path: Path) -> None:
    table = pa.Table.from_pandas(frame, preserve_index=False)
    replace(path, lambda file: write_table(file, table), sync=False)


def _csv(reader: RunReader, path: Path) -> None:
    text = as_csv(reader.metrics())
    replace(path, lambda file: file.write(text.encode()), sync=False)


def _json(reader: RunReader, path: Path) -> None:
    """Write everything that is not an array: configuration, status, labels, rows, profiles."""
    content = {
        "description": reader.config,
        "status": asdict(reader.status),
        "labels": asdict(reader.labels),
        "metrics": reader.metrics().to_dict("records"),
        "profiles": asdict(reader.profiles()),
        "notices": reader.notices(),
    }
    # Last, because reading finds the problems.
    replace_json(path, content | {"problems": reader.problems}, sync=False)


def _tensorboard(reader: RunReader, folder: Path) -> None:
    """Write a scalar for each metric, with the run's own clock."""
    # Imported here because most commands do not need it.
    # Its SummaryWriter writes from a thread, and waits for good for one that died of a full disk.
    from tensorboardX.event_file_writer import EventsWriter
    from tensorboardX.proto import event_pb2
    from tensorboardX.summary import scalar

    event = vars(event_pb2)["Event"]  # made when it is imported
    begun = datetime.fromisoformat(reader.created).timestamp()
    with whole_folder(folder) as unfinished, closing(EventsWriter(f"{unfinished}/events")) as file:
        for row in reader.metrics().to_dict("records"):
            step = int(row.pop("env_step"))
            wall = row.get("time/wall_s", 0.0)
            at = begun + (0.0 if isnan(wall) else wall)
            for name, value in row.items():
                if not isnan(value):  # else this metric has no value at this step
                    summary = scalar(str(name), value)
                    file.write_event(event(wall_time=at, step=step, summary=summary))


def _rrd(reader: RunReader, path: Path) -> None:
    # Imported here because Rerun takes half a second, which other formats do not need.
    from tom.record.rerun.feed import write

    write(reader, path)


EXPORTERS: dict[str, tuple[str, Callable[[RunReader, Path], object]]] = {
    "csv": (".csv", _csv),
    "parquet": (".parquet", lambda reader, path: _write_frame(reader.metrics(), path)),
    "json": (".json", _json),
    "tensorboard": ("", _tensorboard),
    "rrd": (".rrd", _rrd),
}
"""the suffix and the writer of each kind"""
