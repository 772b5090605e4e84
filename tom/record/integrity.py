"""Integrity of a run: `verify` reads every file; `repair` fixes what it can without loss.

Damaged files are moved into the run's `damaged/` folder, never deleted.
"""

import os
from collections.abc import Collection, Iterator, Sequence
from dataclasses import asdict, replace
from datetime import datetime
from pathlib import Path

import pandas as pd
import pyarrow as pa

from tom.config import RunConfig, SacRecordingConfig
from tom.data.unpack import DAMAGE, read_arrays
from tom.errors import reason
from tom.record import checkpoint, digests, layout
from tom.record.decode import read_table, write_table
from tom.record.files import (
    begins_with,
    copy_aside,
    modified,
    read_json_lines,
    replace_json,
    set_aside,
)
from tom.record.files import replace as replace_file
from tom.record.manage import refused, unwritten
from tom.record.mend import mend_lines
from tom.record.reader import RunReader
from tom.record.status import Status

PASSING = ("weights", layout.POLICIES)
"""folders from which a training deletes files as it goes (`RunWriter.snapshot`)"""
ENDED = "its process ended without a word: "
GOES_ON = "tom train --resume {run} goes on from a checkpoint"
NO_WAY_ON = "the run cannot go on"
NO_CHECKPOINT = "it has no checkpoint to go on from"


def verify(reader: RunReader) -> list[str]:
    """All defects of a run, one line each."""
    fresh = RunReader(reader.path)
    _ = fresh.config, fresh.labels
    status = fresh.status
    folder = fresh.path / checkpoint.FOLDER
    held, unread = checkpoint.look_for(folder)  # before the rows, which a training may add to
    fresh.metrics()
    fresh.metric_rows()
    fresh.profiles()
    fresh.notices()
    rows, _ = fresh.buffer()
    fresh.list_folders()
    problems = list(fresh.problems)
    for path in _arrays(fresh.path):
        error = _unreadable(path)
        name = str(path.relative_to(fresh.path))
        if error and path.parent.name in PASSING and path not in path.parent.iterdir():
            continue  # the training has replaced it since it was listed
        if error and not any(name in problem for problem in problems):
            problems.append(f"{name} cannot be read: {error}")
    if status.shown == "dead":
        problems.append(f"says it is running, without a heartbeat since {_when(status.heartbeat)}")
    for name, what in _altered(fresh.path).items():
        if not any(name in problem for problem in problems):
            problems.append(f"{name} {what}")
    if held is not None:
        problems += [*held.problems, *([] if fresh.unread else unlike(fresh.path, held))]
        if len(rows) < (collected := held.state.get("training", {}).get("collected", 0)):
            problems.append(f"{layout.BUFFER} has {len(rows)} of {collected} rows: {NO_WAY_ON}")
    elif unread or checkpoint.newest(folder) is not None:
        problems.append(unread or f"no checkpoint is whole: {NO_WAY_ON}")
    if (fresh.path / layout.MODEL).is_dir() and checkpoint.load(fresh.path / layout.MODEL) is None:
        problems.append(f"{layout.MODEL} is damaged: ghosts and model errors are missing")
    if not status.alive:
        problems += [f"{_name(fresh, p)} is left from an interrupted write" for p in _left(fresh)]
    return problems


def repair(reader: RunReader) -> list[str]:
    """Repair a run; returns what was done, one line each.

    Raises UserError while the run is being written, or if the disk is full: what is mended by then
    stays mended.

    Damaged lines become blank, rows of metrics come back from the Parquet copy if that is whole,
    else the copy is made again. Damaged arrays are set aside, the state of a dead run becomes
    `stopped`, a lost status is made again, and temporary files of an interrupted write are removed.
    """
    done: list[str] = []
    with unwritten(reader), refused(f"cannot repair run '{reader.run_id}'"):
        for path in _left(reader):
            path.unlink()
            done.append(f"{_name(reader, path)}: removed, it was never whole")
        altered = _altered(reader.path)
        mended = [
            _mend_metrics(reader, altered),
            *(_mend_lines(reader, name) for name in layout.LINES[1:]),
        ]
        done += [text for text in mended if text]
        for path in _arrays(reader.path):
            if _name(reader, path) in altered or _unreadable(path):
                done.append(f"{_name(reader, path)}: {_set_aside(reader, path)}")
        done += [text for text in (_mend_status(reader, altered), _mend_table(reader)) if text]
        done += _accept(reader, [name for name in altered if name not in "\n".join(done)])
    return done


def unlike(path: Path, held: checkpoint.Checkpoint) -> list[str]:
    """The rows that differ from what the checkpoint `held` counts on, one line a file.

    Digests of the whole run, which a repair makes anew, count more than those of the checkpoint.
    """
    altered = _altered(path)
    if os.path.lexists(path / layout.DIGESTS) and layout.DIGESTS not in altered:
        return [f"{name} {altered[name]}" for name in layout.LINES if name in altered]
    try:
        files = held.state["record"]["files"]
        sha256 = files.get("sha256", [None] * len(layout.LINES))  # missing in earlier ones
        marks = [*zip(layout.LINES, files["lines"], sha256, strict=True)]
    except (LookupError, TypeError, ValueError):  # another version's, which a resume refuses
        return []
    return [
        f"{name} is not what checkpoint {held.env_step} counts on"
        for name, size, digest in marks
        if not begins_with(path / name, size, digest)
    ]


def _arrays(path: Path) -> Iterator[Path]:
    for folder in ("", *layout.FOLDERS):
        for file in sorted((path / folder).glob("*")):
            if file.suffix in (".npz", ".parquet") and not file.name.startswith("."):
                yield file


def _unreadable(path: Path) -> str | None:
    """Why an array file cannot be read completely; None if it can."""
    try:
        if path.suffix == ".parquet":
            read_table(path)
        else:
            read_arrays(path)
    except DAMAGE as error:
        return reason(error)
    return None


def _altered(path: Path) -> dict[str, str]:
    """The files that differ from what a finished run wrote, with the reason for each."""
    try:
        return digests.changed(path)
    except (OSError, ValueError) as error:
        return {layout.DIGESTS: f"cannot be read: {reason(error)}"}


def _accept(reader: RunReader, altered: Sequence[str]) -> list[str]:
    """Write new digests of a repaired run; returns lines on `altered` files that stay."""
    held = checkpoint.load(reader.path / checkpoint.FOLDER)
    lost = unlike(reader.path, held) if held is not None else []
    if not lost and not _altered(reader.path):
        return []
    digests.write(reader.path)
    kept = [name for name in altered if (reader.path / name).is_file()]
    return [f"{text}: kept as it is now" for text in lost if text.split()[0] not in altered] + [
        f"{name}: made again"
        if name == layout.DIGESTS
        else f"{name}: reads well, and nothing tells what it was: kept"
        for name in kept
    ]


def _left(reader: RunReader) -> list[Path]:
    """Temporary files of an interrupted write."""
    return sorted(p for p in reader.path.rglob(".*.tmp") if p.is_file())


def _mend_metrics(reader: RunReader, altered: Collection[str]) -> str | None:
    """Mend the rows of metrics; a Parquet copy that is whole says what damaged ones were."""
    path = reader.path / layout.METRICS
    rows, problems = read_json_lines(path) if path.is_file() else ([], [])
    whole = layout.METRICS not in altered and rows and not problems
    known = None if whole or layout.METRICS_TABLE in altered else _table(reader)
    return _mend_lines(reader, layout.METRICS, known)


def _mend_lines(reader: RunReader, name: str, table: pd.DataFrame | None = None) -> str | None:
    path = reader.path / name
    there = path.is_file()
    content = path.read_bytes() if there else b""
    mended = mend_lines(content, table)
    if mended.content == content:
        return None
    aside = f"; {_kept(reader, copy_aside(reader.path, path))}" if there else ""
    replace_file(path, lambda file: file.write(mended.content), sync=True)
    back = f", {mended.put_back} rows put back from {layout.METRICS_TABLE}"
    return (
        f"{name}: {mended.damaged} damaged lines blanked out of {mended.lines}"
        f"{back if mended.put_back else ''}{aside}"
    )


def _table(reader: RunReader) -> pd.DataFrame | None:
    """The Parquet copy of the metrics; None if it is not whole."""
    path = reader.path / layout.METRICS_TABLE
    if _unreadable(path):
        return None
    table = read_table(path)
    return table if "env_step" in table else None


def _set_aside(reader: RunReader, path: Path) -> str:
    """Move a file into the run's `damaged/` folder; returns a line that says where."""
    return _kept(reader, set_aside(reader.path, path))


def _kept(reader: RunReader, place: Path) -> str:
    return f"what was there is kept as {_name(reader, place)}"


def _mend_status(reader: RunReader, altered: Collection[str]) -> str | None:
    """Give a final state to a run that is dead or has a damaged status."""
    file, status = reader.path / layout.STATUS, reader.status
    if status.state not in ("running", "unknown"):
        return None
    if status.state == "unknown" and os.path.lexists(file):
        _set_aside(reader, file)
    ended = _ended(reader, status, altered)
    replace_json(file, asdict(ended), sync=True)
    return f"{layout.STATUS}: {status.state} became {ended.state} at step {ended.env_step}"


def _ended(reader: RunReader, status: Status, altered: Collection[str]) -> Status:
    """The final status of a run that says it is running, or of which nothing is known.

    Digests are written when a run has finished, and for a small copy of any run.
    """
    table = reader.metrics()
    held = checkpoint.newest(reader.path / checkpoint.FOLDER)
    reached = max(status.env_step, int(table["env_step"].to_numpy().max(initial=0)))
    total = status.total or _total(reader)
    ended = replace(status, phase="", env_step=reached, total=total, eta_s=None)
    if status.state == "unknown":
        last, best = _last(table, "eval/return"), _last(table, "eval/return_max")
        ended = replace(ended, last_return=last, best_return=best)
        attested = layout.DIGESTS not in altered and (reader.path / layout.DIGESTS).is_file()
        if attested and 0 < total <= max(reached, held or 0):
            return replace(ended, state="finished", env_step=max(reached, total))
    why = NO_CHECKPOINT if held is None else GOES_ON.format(run=reader.run_id)
    return replace(ended, state="stopped", reason=ENDED + why)


def _total(reader: RunReader) -> int:
    """The last step of the run's events; 0 if its settings are damaged."""
    settings = reader.config.get("config")
    steps = settings.get("steps") if isinstance(settings, dict) else None
    kind = RunConfig if reader.fits_model else SacRecordingConfig
    return kind.model_construct(steps=steps).total_steps if isinstance(steps, int) else 0


def _last(table: pd.DataFrame, name: str) -> float | None:
    """The last value of a metric; None if it has none."""
    values = table[name].dropna().tolist() if name in table else []
    return values[-1] if values else None


def _mend_table(reader: RunReader) -> str | None:
    """Make the Parquet copy of the metrics again, unless it is that of the rows."""
    rows, table = reader.path / layout.METRICS, reader.path / layout.METRICS_TABLE
    if modified(table) >= modified(rows):
        return None
    held, now = _table(reader), reader.metrics()
    if held is not None and _plain(held).equals(_plain(now)):
        os.utime(table)  # readers take the newer one
        return None
    aside = f"; {_set_aside(reader, table)}" if os.path.lexists(table) else ""
    content = pa.Table.from_pandas(now, preserve_index=False)
    replace_file(table, lambda file: write_table(file, content), sync=True)
    return f"{layout.METRICS_TABLE}: made again{aside}"


def _plain(table: pd.DataFrame) -> pd.DataFrame:
    """The values of a table, whatever the order of its columns."""
    return table.dropna(axis=1, how="all").sort_index(axis=1)


def _name(reader: RunReader, path: Path) -> str:
    return str(path.relative_to(reader.path))


def _when(unix: float) -> str:
    if unix <= 0:
        return "ever"
    return datetime.fromtimestamp(unix).isoformat(" ", "seconds")
