"""Integrity of a run: `verify` reads every file; `repair` fixes what it can without loss.

Damaged files are moved into the run's `damaged/` folder, never deleted.
"""

import os
from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from datetime import datetime
from pathlib import Path

import pyarrow as pa

from tom.errors import reason
from tom.record import checkpoint, digests, layout
from tom.record.array_files import DAMAGE, read_arrays, read_table, write_table
from tom.record.files import modified, parse_json_line, read_json_lines, replace_json
from tom.record.files import replace as replace_file
from tom.record.manage import unwritten
from tom.record.opening import refuse_links
from tom.record.reader import RunReader

LINES = (layout.METRICS, layout.PROFILES, layout.NOTICES)
ENDED = "its process ended without a word: "
GOES_ON = "tom train --resume {run} goes on from a checkpoint"
NO_CHECKPOINT = "it has no checkpoint to go on from"


def verify(reader: RunReader) -> list[str]:
    """All defects of a run, one line each."""
    fresh = RunReader(reader.path)
    _ = fresh.config, fresh.labels
    status = fresh.status
    fresh.metrics()
    fresh.profiles()
    fresh.notices()
    fresh.buffer()
    problems = list(fresh.problems)
    for path in _arrays(fresh.path):
        error = _unreadable(path, fresh.most_bytes)
        name = str(path.relative_to(fresh.path))
        if error and not any(name in problem for problem in problems):
            problems.append(f"{name} cannot be read: {error}")
    if status.shown == "dead":
        problems.append(f"says it is running, without a heartbeat since {_when(status.heartbeat)}")
    for name, what in _altered(fresh.path).items():
        if not any(name in problem for problem in problems):
            problems.append(f"{name} {what}")
    folder = fresh.path / checkpoint.FOLDER
    held = checkpoint.load(folder)
    problems += held.problems if held else []
    if held is None and checkpoint.newest(folder) is not None:
        problems.append("no checkpoint is whole: the run cannot go on")
    if (fresh.path / layout.MODEL).is_dir() and checkpoint.load(fresh.path / layout.MODEL) is None:
        problems.append(f"{layout.MODEL} is damaged: ghosts and model errors are missing")
    if not status.alive:
        problems += [f"{_name(fresh, p)} is left from an interrupted write" for p in _left(fresh)]
    return problems


def repair(reader: RunReader) -> list[str]:
    """Repair a run; returns what was done, one line each.

    Raises UserError while the run is being written, and if a part of it is a link.

    Damaged lines become blank, damaged arrays are set aside, the state of a dead run becomes
    `stopped`, the Parquet copy is made again, and temporary files of an interrupted write are
    removed.
    """
    done: list[str] = []
    refuse_links(reader.path)
    with unwritten(reader):
        for path in _left(reader):
            path.unlink()
            done.append(f"{_name(reader, path)}: removed, it was never whole")
        done += [text for name in LINES if (text := _mend_lines(reader, name))]
        altered = _altered(reader.path)
        for path in _arrays(reader.path):
            if _name(reader, path) in altered or _unreadable(path, reader.most_bytes):
                done.append(f"{_name(reader, path)}: {_set_aside(reader, path)}")
        done += [text for text in (_mend_status(reader), _mend_table(reader)) if text]
        done += _accept(reader, [name for name in altered if name not in "\n".join(done)])
    return done


def _arrays(path: Path) -> Iterator[Path]:
    for folder in ("", *layout.FOLDERS):
        for file in sorted((path / folder).glob("*")):
            if file.suffix in (".npz", ".parquet") and not file.name.startswith("."):
                yield file


def _unreadable(path: Path, most: int) -> str | None:
    """Why an array file cannot be read completely (at most `most` bytes); None if it can."""
    try:
        if path.is_symlink():
            raise ValueError("a link is not followed")
        if path.suffix == ".parquet":
            read_table(path, most)
        else:
            read_arrays(path, most)
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
    if not _altered(reader.path):
        return []
    if (reader.path / layout.DIGESTS).is_dir():
        _set_aside(reader, reader.path / layout.DIGESTS)
    digests.write(reader.path)
    kept = [name for name in altered if (reader.path / name).is_file()]
    return [
        f"{name}: made again"
        if name == layout.DIGESTS
        else f"{name}: reads well, and nothing tells what it was: kept"
        for name in kept
    ]


def _left(reader: RunReader) -> list[Path]:
    """Temporary files of an interrupted write."""
    return sorted(p for p in reader.path.rglob(".*.tmp") if p.is_file() and not p.is_symlink())


def _mend_lines(reader: RunReader, name: str) -> str | None:
    path = reader.path / name
    if not path.is_file():
        return None
    rows, problems = read_json_lines(path)
    if not problems:
        return None
    lines = path.read_bytes().split(b"\n")[:-1]
    # Blanks take the place of a damaged line, because checkpoints hold the length of the file.
    good = b"".join(
        (b" " * len(line) if parse_json_line(line) is None else line) + b"\n" for line in lines
    )
    aside = _set_aside(reader, path)
    replace_file(path, lambda file: file.write(good), sync=True)
    return (
        f"{name}: {len(problems)} damaged lines blanked out of {len(rows) + len(problems)}; {aside}"
    )


def _set_aside(reader: RunReader, path: Path) -> str:
    """Move a damaged file into the run's `damaged/` folder; returns a line that says where."""
    place = reader.path / layout.DAMAGED / path.relative_to(reader.path)
    place.parent.mkdir(parents=True, exist_ok=True)
    number = 1
    while os.path.lexists(place):
        number += 1
        place = place.with_name(f"{path.name}~{number}")
    path.rename(place)
    return f"the damaged one is kept as {_name(reader, place)}"


def _mend_status(reader: RunReader) -> str | None:
    """Give a final state to a run that is dead or has a damaged status."""
    file, status = reader.path / layout.STATUS, reader.status
    if status.state not in ("running", "unknown"):
        return None
    if status.state == "unknown" and os.path.lexists(file):
        _set_aside(reader, file)
    table = reader.metrics()
    last = int(table["env_step"].to_numpy().max(initial=0))
    total = reader.config.get("config", {}).get("steps", 0)
    held = checkpoint.newest(reader.path / checkpoint.FOLDER)
    ended = replace(
        status,
        state="stopped",
        phase="",
        reason=ENDED + (GOES_ON.format(run=reader.run_id) if held is not None else NO_CHECKPOINT),
        env_step=max(status.env_step, last),
        total=status.total or (total if isinstance(total, int) else 0),
        eta_s=None,
    )
    replace_json(file, asdict(ended), sync=True)
    return f"{layout.STATUS}: {status.state} became stopped at step {ended.env_step}"


def _mend_table(reader: RunReader) -> str | None:
    rows, table = reader.path / layout.METRICS, reader.path / layout.METRICS_TABLE
    if modified(table) >= modified(rows):
        return None
    content = pa.Table.from_pandas(reader.metrics(), preserve_index=False)
    replace_file(table, lambda file: write_table(file, content), sync=True)
    return f"{layout.METRICS_TABLE}: made again"


def _name(reader: RunReader, path: Path) -> str:
    return str(path.relative_to(reader.path))


def _when(unix: float) -> str:
    return datetime.fromtimestamp(unix).isoformat(" ", "seconds") if unix > 0 else "ever"
