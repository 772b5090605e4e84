"""Integrity of a run: `verify` reads every file; `repair` fixes what it can without loss.

A finished run has `digests.json`: the sha256 of every file, by which any changed bit is found.
Left out are files that may change or be removed afterwards: the status and the labels, recordings,
which can be made again from the files, and checkpoints, whose manifests have their own digests.
A repair moves damaged files into the run's `damaged/` folder and never deletes one.
"""

import hashlib
import os
from collections.abc import Iterator
from dataclasses import asdict, replace
from datetime import datetime
from pathlib import Path

import pyarrow as pa

from tom.config import RunConfig, SacRecordingConfig
from tom.data.unpack import DAMAGE, read_arrays
from tom.errors import TryLaterError, reason
from tom.record import checkpoint, layout
from tom.record.decode import numbers, read_table, write_table
from tom.record.files import (
    begins_with,
    files_in,
    json_line,
    parse_json_line,
    read_json,
    replace_json,
    set_aside,
)
from tom.record.files import replace as replace_file
from tom.record.manage import refused, unwritten
from tom.record.reader import RunReader

SCHEMA = 1
LEFT_OUT = (
    layout.STATUS, layout.LABELS, layout.DIGESTS, checkpoint.FOLDER, layout.DAMAGED,
)  # fmt: skip
"""files and folders without digests"""


def write_digests(path: Path) -> None:
    """Write the digests of the run folder `path`. Raises OSError."""
    digests = {name: _sha256(path / name) for name in _with_digest(path)}
    replace_json(path / layout.DIGESTS, {"schema": SCHEMA, "sha256": digests}, sync=True)


def verify(reader: RunReader) -> list[str]:
    """All defects of a run, one line each."""
    run = RunReader(reader.path)
    held, unread = None, ""  # the checkpoint first: a training may add to the rows
    try:
        held = checkpoint.load(run.path / checkpoint.FOLDER)
    except TryLaterError as error:
        unread = str(error).removeprefix(f"{run.run_id}: ")
    _ = run.config, run.labels, run.status
    for read in (run.metrics, run.metric_rows, run.profiles, run.notices, run.list_folders):
        read()
    rows, _ = run.buffer()
    unreadable = {
        f"{_name(run, path)} cannot be read: {error}"
        for path in _arrays(run.path)
        if (error := _unreadable(path)) and path.exists()  # a training deletes weights as it goes
    }
    problems = list(run.problems)
    for found in (sorted(unreadable), (f"{n} {what}" for n, what in _altered(run.path).items())):
        named = "\n".join(problems)
        problems += [problem for problem in found if problem.split()[0] not in named]
    if run.status.shown == "dead":
        last = datetime.fromtimestamp(max(run.status.heartbeat, 0))
        problems.append(f"says it is running, without a heartbeat since {last:%Y-%m-%d %H:%M:%S}")
    if held is not None:
        problems += [*held.problems, *([] if run.unread else unlike(run.path, held))]
        if len(rows) < (collected := held.state.get("training", {}).get("collected", 0)):
            problems.append(
                f"{layout.BUFFER} has {len(rows)} of {collected} rows: the run cannot go on"
            )
    elif unread or checkpoint.newest(run.path / checkpoint.FOLDER) is not None:
        problems.append(unread or "no checkpoint is whole: the run cannot go on")
    if any(not checkpoint.is_whole(p) for p in checkpoint.folders(run.path / layout.MODEL)):
        problems.append(f"{layout.MODEL} is damaged: ghosts and model errors are missing")
    if not run.status.alive:
        problems += [f"{_name(run, p)} is left from an interrupted write" for p in _left(run)]
    return problems


def repair(reader: RunReader) -> list[str]:
    """Repair a run; returns what was done, one line each.

    Damaged lines become blank, and rows of metrics come back from the Parquet copy if that is
    whole. Damaged arrays are set aside, the state of a dead run
    becomes `stopped`, a lost status is made again, and temporary files of an interrupted write are
    removed. Raises UserError while the run is being written, or if the disk is full: what is
    repaired by then stays repaired.
    """
    done: list[str] = []
    with unwritten(reader), refused(f"cannot repair run '{reader.run_id}'"):
        altered = _altered(reader.path)
        for path in _left(reader):
            path.unlink()
            done.append(f"{_name(reader, path)}: removed, it was never whole")
        done += _repair_metrics(reader, altered)
        for name in layout.LINES:
            done += _blank_damaged_lines(reader, name)
        for path in _arrays(reader.path):
            if _name(reader, path) in altered or _unreadable(path):
                done.append(f"{_name(reader, path)}: {_set_aside(reader, path)}")
        if not (table := reader.path / layout.METRICS_TABLE).exists():
            rows = pa.Table.from_pandas(reader.metric_rows(), preserve_index=False)
            replace_file(table, lambda file: write_table(file, rows), sync=True)
            done.append(f"{layout.METRICS_TABLE}: made again")
        done += _repair_status(reader, altered)
        done += _renew_digests(reader, altered, "\n".join(done))
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
        marks = [*zip(layout.LINES, files["lines"], files["sha256"], strict=True)]
    except (LookupError, TypeError, ValueError):  # another version's, which a resume refuses
        return []
    return [
        f"{name} is not what checkpoint {held.env_step} counts on"
        for name, size, digest in marks
        if not begins_with(path / name, size, digest)
    ]


def _with_digest(path: Path) -> list[str]:
    """The names of the files that have a digest, sorted."""
    recordings = layout.rrd_files(path)
    files = [file.relative_to(path) for file, _ in files_in(path) if file not in recordings]
    return sorted(
        name.as_posix()
        for name in files
        if name.parts[0] not in LEFT_OUT and not any(part.startswith(".") for part in name.parts)
    )


def _altered(path: Path) -> dict[str, str]:
    """The files that differ from what a finished run wrote, with the reason for each."""
    if not (path / layout.DIGESTS).exists():  # not finished, or of an earlier version
        return {}
    try:
        content = read_json(path / layout.DIGESTS)
        if content["schema"] != SCHEMA:
            raise ValueError(f"schema {content['schema']} is not {SCHEMA}")
        written, there = content["sha256"], {*_with_digest(path)}
        gone = dict.fromkeys({*written} - there, "is missing since the run finished")
        return gone | {
            name: "is not what the run wrote (sha256 differs)"
            for name in sorted(there & {*written})
            if _sha256(path / name) != written[name]
        }
    except (OSError, ValueError, LookupError, TypeError) as error:
        return {layout.DIGESTS: f"cannot be read: {reason(error)}"}


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _arrays(path: Path) -> Iterator[Path]:
    for folder in ("", *layout.FOLDERS):
        for file in sorted((path / folder).glob("[!.]*")):
            if file.suffix in (".npz", ".parquet"):
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


def _left(reader: RunReader) -> list[Path]:
    """Temporary files of an interrupted write."""
    return sorted(p for p in reader.path.rglob(".*.tmp") if p.is_file())


def _repair_metrics(reader: RunReader, altered: dict[str, str]) -> list[str]:
    """Write damaged rows of metrics anew from their Parquet copy, if that is whole.

    Rows after the last of the copy stay.
    """
    path, copy = reader.path / layout.METRICS, reader.path / layout.METRICS_TABLE
    content = path.read_bytes() if path.is_file() else b""
    rows = [parse_json_line(line) for line in content.split(b"\n") if line.strip()]
    whole = rows and None not in rows and content.endswith(b"\n") and layout.METRICS not in altered
    if whole or layout.METRICS_TABLE in altered or _unreadable(copy):
        return []
    copied = read_table(copy).to_dict("records")
    last = copied[-1]["env_step"] if copied else -1
    later = (row for row in rows if row is not None and row.get("env_step", 0) > last)
    back = ({"env_step": int(row["env_step"]), **numbers(row)} for row in copied)
    text = b"".join(map(json_line, (*back, *later)))
    return [_replace_rows(reader, path, text, f"{len(copied)} rows of {layout.METRICS_TABLE}")]


def _blank_damaged_lines(reader: RunReader, name: str) -> list[str]:
    """Make the damaged lines of a file blank, and cut off half a last one.

    Every other line stays where it is, because checkpoints hold the length of the file.
    """
    path = reader.path / name
    content = path.read_bytes() if path.is_file() else b""
    *lines, half = content.split(b"\n")
    mended = [b" " * len(line) if parse_json_line(line) is None else line for line in lines]
    text = b"".join(line + b"\n" for line in mended)
    if text == content:
        return []
    damaged = sum(a != b for a, b in zip(lines, mended, strict=True)) + bool(half)
    return [_replace_rows(reader, path, text, f"{damaged} damaged lines blanked out")]


def _replace_rows(reader: RunReader, path: Path, text: bytes, what: str) -> str:
    kept = f"; {_set_aside(reader, path, copy=True)}" if path.is_file() else ""
    replace_file(path, lambda file: file.write(text), sync=True)
    return f"{_name(reader, path)}: {what}{kept}"


def _repair_status(reader: RunReader, altered: dict[str, str]) -> list[str]:
    """Give a final state to a run that is dead or has a damaged status."""
    file, status = reader.path / layout.STATUS, reader.status
    if status.state not in ("running", "unknown"):
        return []
    table, newest = reader.metrics(), checkpoint.newest(reader.path / checkpoint.FOLDER)
    last = table.ffill().iloc[-1].to_dict() if len(table) else {}
    settings = reader.config.get("config")
    steps = settings.get("steps") if isinstance(settings, dict) else None
    kind = RunConfig if reader.fits_model else SacRecordingConfig
    planned = kind.model_construct(steps=steps).total_steps if isinstance(steps, int) else 0
    reached, total = max(status.env_step, int(last.get("env_step", 0))), status.total or planned
    goes_on = f"tom train --resume {reader.run_id} goes on from a checkpoint"
    why = "it has no checkpoint to go on from" if newest is None else goes_on
    ended = replace(
        status,
        state="stopped",
        phase="",
        env_step=reached,
        total=total,
        eta_s=None,
        reason=f"its process ended without a word: {why}",
    )
    if status.state == "unknown":
        ended = replace(
            ended, last_return=last.get("eval/return"), best_return=last.get("eval/return_max")
        )
        # A run has digests once it has finished; its last row may be of an earlier step.
        attested = (reader.path / layout.DIGESTS).is_file() and layout.DIGESTS not in altered
        if attested and 0 < total <= max(reached, newest or 0):
            ended = replace(ended, state="finished", env_step=max(reached, total), reason="")
        if os.path.lexists(file):
            _set_aside(reader, file)
    replace_json(file, asdict(ended), sync=True)
    return [f"{layout.STATUS}: {status.state} became {ended.state} at step {ended.env_step}"]


def _renew_digests(reader: RunReader, altered: dict[str, str], done: str) -> list[str]:
    """Write new digests of a repaired run; returns lines on files that stay as they are now."""
    held = checkpoint.load(reader.path / checkpoint.FOLDER)
    lost = [] if held is None else [text.split()[0] for text in unlike(reader.path, held)]
    if not lost and not _altered(reader.path):
        return []
    write_digests(reader.path)
    stay = dict.fromkeys(name for name in (*altered, *lost) if (reader.path / name).is_file())
    return [
        f"{layout.DIGESTS}: made again" if name == layout.DIGESTS else f"{name}: kept as it is now"
        for name in stay
        if name not in done
    ]


def _set_aside(reader: RunReader, path: Path, *, copy: bool = False) -> str:
    """Move or copy a file into the run's `damaged/` folder; returns a phrase that says where."""
    place = set_aside(reader.path, path, copy=copy)
    return f"what was there is kept as {_name(reader, place)}"


def _name(reader: RunReader, path: Path) -> str:
    return path.relative_to(reader.path).as_posix()
