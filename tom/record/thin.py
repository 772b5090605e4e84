"""A small copy of a run: what its pages show, in well under a megabyte. The run itself stays.

Numbers keep fewer digits and series fewer points; the replay buffer, checkpoints and recordings
are left out unless they are small. `config.json` of the copy says so under `thinned`.
"""

import json
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from tom.record import layout
from tom.record.files import plain, replace_json
from tom.record.profiles import Profiles
from tom.record.reader import RunReader

ROWS = 400  # of metrics; every row of an evaluation is kept beyond them
FITS = 120  # weight profiles
SNAPSHOTS = 3
EVALUATIONS = 3
FIELD_STEPS = 6
BUFFER_BYTES = 200_000
DIGITS = 5
MANTISSA_BITS = 10  # of float32's 23: an error of 0.05 % at most


def thin(reader: RunReader, path: Path) -> None:
    """Write a small copy of the run to `path`, which appears whole or not at all."""
    unfinished = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        for folder in ("weights", "episodes", "buffer", "fields"):
            (unfinished / folder).mkdir(parents=True)
        _copy(reader, unfinished)
        unfinished.rename(path)
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)


def _copy(reader: RunReader, to: Path) -> None:
    for name in (layout.STATUS, layout.LABELS, layout.NOTICES):
        if (reader.path / name).is_file():
            shutil.copyfile(reader.path / name, to / name)
    _lines(to / layout.METRICS, _chosen_rows(reader))
    _lines(to / layout.PROFILES, _profile_rows(reader.profiles()))
    snapshots = _spread(reader.snapshot_steps(), SNAPSHOTS)
    for step in snapshots:
        _snapshot(reader, step, to)
    evaluations = _spread(reader.evaluation_steps(), EVALUATIONS)
    for step in evaluations:
        _arrays(reader.path, to, layout.episodes(step), first_episode=True)
    for name in reader.field_names():
        for step in _spread(reader.field_steps(name), FIELD_STEPS):
            _arrays(reader.path, to, layout.field(name, step))
    kept = _buffer(reader, to)
    replace_json(to / layout.CONFIG, _description(reader, kept), sync=False)


def _description(reader: RunReader, buffer_kept: bool) -> dict[str, Any]:
    left_out = ["checkpoint", "recording", "policy", "per-dimension weights"]
    note = {
        "rows_of_metrics": ROWS,
        "profiles": FITS,
        "snapshots": SNAPSHOTS,
        "evaluations": EVALUATIONS,
        "episodes_of_an_evaluation": 1,
        "left_out": left_out if buffer_kept else ["buffer", *left_out],
    }
    return {**reader.config, "thinned": note}


def _chosen_rows(reader: RunReader) -> Iterator[dict[str, Any]]:
    table = reader.metrics()
    keep = np.zeros(len(table), bool)
    keep[_spread(range(len(table)), ROWS)] = True
    if "eval/return" in table:
        keep |= table["eval/return"].notna().to_numpy()
    for row in table.loc[keep].to_dict("records"):
        step = int(row.pop("env_step"))
        yield {"env_step": step, **{k: _short(v) for k, v in row.items() if v == v}}


def _profile_rows(profiles: Profiles) -> Iterator[dict[str, Any]]:
    for i in _spread(range(len(profiles.env_step)), FITS):
        yield {
            "env_step": int(profiles.env_step[i]),
            "count": int(profiles.count[i]),
            "bins": [_short(value) for value in profiles.bins[i]],
            "ess": _short(profiles.ess[i]),
            "zeros": _short(profiles.zeros[i]),
        }


def _snapshot(reader: RunReader, step: int, to: Path) -> None:
    frame = reader.snapshot(step)
    columns = [name for name in ("weight", "log_ratio") if name in frame]
    table = pa.table({name: coarse(frame[name].to_numpy()) for name in columns})
    pq.write_table(
        table,
        to / layout.snapshot(step),
        compression="zstd",
        compression_level=19,
        use_dictionary=False,
        use_byte_stream_split=True,
    )


def _buffer(reader: RunReader, to: Path) -> bool:
    """Copy the buffer where it stays small: a map of road-and-rocks needs its places."""
    firsts = layout.numbers(reader.path / "buffer", ".npz")
    for first in firsts:
        _arrays(reader.path, to, layout.segment(first))
    if sum(path.stat().st_size for path in (to / "buffer").iterdir()) <= BUFFER_BYTES:
        return bool(firsts)
    for path in (to / "buffer").iterdir():
        path.unlink()
    return False


def _arrays(source: Path, to: Path, name: str, *, first_episode: bool = False) -> None:
    """Copy the arrays of a file, or those of its first episode alone."""
    try:
        with np.load(source / name, allow_pickle=False) as file:
            named = {n: n.partition(".")[0] for n in file.files}  # info_0.success: info_0
            chosen = [n for n in named if not first_episode or named[n].endswith("_0")]
            arrays: Mapping[str, NDArray] = {n: coarse(file[n]) for n in chosen}
    except (OSError, ValueError):
        return  # damaged: `tom runs verify` names it
    np.savez_compressed(to / name, allow_pickle=False, **arrays)


def coarse(array: NDArray) -> NDArray:
    """Floats rounded to MANTISSA_BITS as float32, which compresses well; the rest as it is."""
    if not np.issubdtype(array.dtype, np.floating):
        return array
    single = np.array(array, np.float32, order="C")
    cut = 23 - MANTISSA_BITS
    bits = single.view(np.uint32).astype(np.uint64) + (1 << (cut - 1))  # round, not truncate
    rounded = ((bits >> cut) << cut).astype(np.uint32).view(np.float32)
    return np.where(np.isfinite(single), rounded, single)


def _short(value: Any) -> Any:
    number = plain(value)
    return float(f"{number:.{DIGITS}g}") if isinstance(number, float) else number


def _spread(items: Sequence[int], most: int) -> list[int]:
    """At most `most` of `items`, evenly, with the first and the last."""
    if len(items) <= most:
        return list(items)
    return [items[i] for i in np.linspace(0, len(items) - 1, most).round().astype(int)]


def _lines(path: Path, rows: Iterator[dict[str, Any]]) -> None:
    text = "".join(json.dumps(plain(row), separators=(",", ":")) + "\n" for row in rows)
    path.write_text(text)
