"""Integrity of a run: `verify` reads every file; `repair` fixes what it can without loss.

A finished run has `digests.json`: the sha256 of every file, by which any changed bit is found.
Left out are files that may change or be removed afterwards: the status and the labels, recordings,
which can be made again from the files, and checkpoints and live weights, which have their own.
A repair moves damaged files into the run's `damaged/` folder and never deletes one.
"""

import hashlib
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
    layout.STATUS, layout.LABELS, layout.DIGESTS, checkpoint.FOLDER, layout.DAMAGED, layout.LIVE,
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
    problems = list(run.problems)
    found = [f"{name} cannot be read: {why}" for name, why in _unreadable(run.path).items()]
    for more in (found, [f"{name} {what}" for name, what in _altered(run.path).items()]):
        named = "\n".join(problems)
        problems += [problem for problem in more if problem.split()[0] not in named]
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
    for learner, live in run.live().items():
        problems += [f"{layout.LIVE}/{learner}/{problem}" for problem in verify(live)]
    if not run.status.alive:
        problems += [f"{name} is left from an interrupted write" for name in _left(run.path)]
    return problems


def repair(reader: RunReader) -> list[str]:
    """Repair a run; returns what was done, one line each.

    Damaged lines become blank, and rows of metrics come back from the Parquet copy if that is
    whole. Damaged arrays are set aside, the state of a dead run
    becomes `stopped`, a lost status is made again, and temporary files of an interrupted write are
    removed. Raises UserError while the run is being written, or if the disk is full: what is
    repaired by then stays repaired.
    """
    run, done = reader.path, dict[str, str]()
    with unwritten(reader), refused(f"cannot repair run '{reader.run_id}'"):
        altered, unreadable = _altered(run), _unreadable(run)
        for name in _left(run):
            (run / name).unlink()
            done[name] = "removed, it was never whole"
        for name in layout.LINES:
            text, what = _whole_rows(run / name), "damaged lines blanked out"
            if name == layout.METRICS and (
                text is not None or name in altered or not _rows(run / name)
            ):
                back = b"" if layout.METRICS_TABLE in altered | unreadable else _copied_rows(run)
                if back:
                    text, what = back, f"the rows of {layout.METRICS_TABLE} are back"
            if text is not None:
                kept = set_aside(run, run / name, copy=True) if (run / name).is_file() else None
                replace_file(run / name, lambda file, text=text: file.write(text), sync=True)
                done[name] = what + _where(run, kept)
        for name in dict.fromkeys((*altered, *unreadable)):
            if Path(name).suffix in (".npz", ".parquet") and (run / name).is_file():
                done[name] = f"set aside{_where(run, set_aside(run, run / name))}"
        if not (run / layout.METRICS_TABLE).exists():
            rows = pa.Table.from_pandas(reader.metric_rows(), preserve_index=False)
            replace_file(run / layout.METRICS_TABLE, lambda f: write_table(f, rows), sync=True)
            done[layout.METRICS_TABLE] = "made again"
        if reader.status.state in ("running", "unknown"):
            done[layout.STATUS] = _end_status(reader, layout.DIGESTS not in altered)
        held = checkpoint.load(run / checkpoint.FOLDER)
        lost = [] if held is None else [text.split()[0] for text in unlike(run, held)]
        if lost or _altered(run):
            write_digests(run)
            for name in (*altered, *lost):
                if (run / name).is_file():
                    made_again = name == layout.DIGESTS
                    done.setdefault(name, "made again" if made_again else "kept as it is now")
    return [f"{name}: {what}" for name, what in done.items()]


def unlike(path: Path, held: checkpoint.Checkpoint) -> list[str]:
    """The rows that differ from what the checkpoint `held` counts on, one line a file.

    Digests of the whole run, which a repair makes anew, count more than those of the checkpoint.
    """
    altered = _altered(path)
    if (path / layout.DIGESTS).exists() and layout.DIGESTS not in altered:
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


def _unreadable(path: Path) -> dict[str, str]:
    """The array files that cannot be read completely, with the reason for each."""
    found = {}
    for folder in ("", *layout.FOLDERS):
        for file in sorted((path / folder).glob("[!.]*")):
            try:
                if file.suffix == ".parquet":
                    read_table(file)
                elif file.suffix == ".npz":
                    read_arrays(file)
            except FileNotFoundError:  # a training deletes weights as it goes
                continue
            except DAMAGE as error:
                found[file.relative_to(path).as_posix()] = reason(error)
    return found


def _left(path: Path) -> list[str]:
    """Temporary files of an interrupted write."""
    found = (file for file in path.rglob(".*.tmp") if file.is_file())
    return sorted(file.relative_to(path).as_posix() for file in found)


def _rows(path: Path) -> bytes:
    return path.read_bytes() if path.is_file() else b""


def _whole_rows(path: Path) -> bytes | None:
    """The file with damaged lines blank and half a last one cut off; None if there are none.

    Every other line stays where it is, because checkpoints hold the length of the file.
    """
    content = _rows(path)
    *lines, _ = content.split(b"\n")
    mended = (b" " * len(line) if parse_json_line(line) is None else line for line in lines)
    text = b"".join(line + b"\n" for line in mended)
    return None if text == content else text


def _copied_rows(path: Path) -> bytes:
    """The rows of metrics as their Parquet copy has them, and those after its last step."""
    copy = path / layout.METRICS_TABLE
    copied = read_table(copy).to_dict("records") if copy.is_file() else []
    if not copied:
        return b""
    held = map(parse_json_line, _rows(path / layout.METRICS).splitlines())
    later = (row for row in held if row and row.get("env_step", 0) > copied[-1]["env_step"])
    back = ({"env_step": int(row["env_step"]), **numbers(row)} for row in copied)
    return b"".join(map(json_line, (*back, *later)))


def _end_status(reader: RunReader, attested: bool) -> str:
    """Give a final state to a run that is dead or has a damaged status; returns what was done.

    Only a run that has finished has digests, which are `attested` if they can be read.
    """
    file, status = reader.path / layout.STATUS, reader.status
    table, newest = reader.metrics(), checkpoint.newest(reader.path / checkpoint.FOLDER)
    last = table.ffill().iloc[-1].to_dict() if len(table) else {}
    steps = reader.given.get("steps")
    kind = RunConfig if reader.fits_model else SacRecordingConfig
    planned = kind.model_construct(steps=steps).total_steps if isinstance(steps, int) else 0
    reached, total = max(status.env_step, int(last.get("env_step", 0))), status.total or planned
    goes_on = f"tom train --resume {reader.run_id} goes on from a checkpoint"
    why = "it has no checkpoint to go on from" if newest is None else goes_on
    why = f"its process ended without a word: {why}"
    ended = replace(
        status, state="stopped", phase="", env_step=reached, total=total, eta_s=None, reason=why
    )
    if status.state == "unknown":
        best = last.get("eval/return_max")
        ended = replace(ended, last_return=last.get("eval/return"), best_return=best)
        # The last row may be of an earlier step.
        attested = attested and (reader.path / layout.DIGESTS).is_file()
        if attested and 0 < total <= max(reached, newest or 0):
            ended = replace(ended, state="finished", env_step=max(reached, total), reason="")
        if file.exists():
            set_aside(reader.path, file)
    replace_json(file, asdict(ended), sync=True)
    return f"{status.state} became {ended.state} at step {ended.env_step}"


def _where(run: Path, place: Path | None) -> str:
    return f"; what was there is kept as {place.relative_to(run)}" if place else ""
