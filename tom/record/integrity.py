"""Integrity of a run: `verify` reads every file; `repair` takes what is damaged out of the way.

A finished run has `digests.json`: the sha256 of every file, by which any changed bit is found.
Left out are files that may change or be removed afterwards: the status and the labels, recordings,
which can be made again from the files, and checkpoints and live weights, which have their own.
A repair moves damaged files into the run's `damaged/` folder and never deletes one.
"""

import hashlib
from contextlib import closing
from dataclasses import asdict
from dataclasses import replace as but
from datetime import datetime
from pathlib import Path

from tom.data.unpack import DAMAGE, read_arrays
from tom.errors import TryLaterError, reason
from tom.record import checkpoint, layout, lock
from tom.record.decode import read_table
from tom.record.files import (
    files_in,
    modified,
    parse_json_line,
    read_json,
    replace,
    replace_json,
    set_aside,
)
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
    run, held, problems = RunReader(reader.path), None, list[str]()
    try:  # first, because a training may add to the rows
        held = checkpoint.load(run.path / checkpoint.FOLDER)
        if held is None and checkpoint.newest(run.path / checkpoint.FOLDER) is not None:
            problems.append("no checkpoint is whole: the run cannot be resumed")
    except TryLaterError as error:
        problems.append(str(error).removeprefix(f"{run.run_id}: "))
    _ = run.config, run.labels, run.status
    for read in (run.metric_rows, run.profiles, run.notices, run.list_folders):
        read()
    rows, _ = run.buffer()
    named = " ".join(run.problems)
    found = [f"{name} {why}" for name, why in _damaged(run.path).items() if name not in named]
    problems = [*run.problems, *found, *problems]
    if run.status.shown == "dead":
        last = datetime.fromtimestamp(max(run.status.heartbeat, 0))
        problems.append(f"says it is running, without a heartbeat since {last:%Y-%m-%d %H:%M:%S}")
    if held is not None:
        problems += held.unusable.values()
        if len(rows) < (collected := held.state.get("training", {}).get("collected", 0)):
            problems.append(
                f"{layout.BUFFER} has {len(rows)} of {collected} rows: the run cannot be resumed"
            )
    if not all(map(checkpoint.is_whole, checkpoint.folders(run.path / layout.MODEL))):
        problems.append(f"{layout.MODEL} is damaged: ghosts and model errors are missing")
    for learner, live in run.live().items():
        problems += [f"{layout.LIVE}/{learner}: {problem}" for problem in verify(live)]
    return problems


def repair(reader: RunReader) -> list[str]:
    """Take what is damaged out of the way of a run; returns what was done, one line each.

    Damaged lines become blank, damaged arrays are set aside, and a dead run becomes `stopped`, also
    in its live weights. Raises UserError while the run is being written, and OSError; what is
    repaired by then stays repaired.
    """
    run, done = reader.path, dict[str, str]()
    with closing(lock.acquire(run)):
        damaged = _damaged(run)
        table = run / layout.METRICS_TABLE
        is_newest = modified(table) >= modified(run / layout.METRICS) > 0
        for name in filter(lambda name: (run / name).is_file(), layout.LINES):
            content = (run / name).read_bytes()
            *lines, _ = content.split(b"\n")
            # Every other line stays where it is, because checkpoints hold the length of the file.
            kept = (b" " * len(line) if parse_json_line(line) is None else line for line in lines)
            text = b"".join(line + b"\n" for line in kept)
            if text != content:
                place = set_aside(run, run / name, copy=True)
                replace(run / name, lambda file, text=text: file.write(text), sync=True)
                done[name] = f"damaged lines blanked out{_kept(run, place)}"
        if is_newest and layout.METRICS in done:
            table.touch()  # it stays what is read: it has the rows that became blank
        for name in damaged:
            if Path(name).suffix in (".npz", ".parquet") and (run / name).is_file():
                done[name] = f"set aside{_kept(run, set_aside(run, run / name))}"
        status = RunReader(run).status
        if status.state == "running":
            why = "its process ended without a reason"
            ended = but(status, state="stopped", phase="", eta_s=None, reason=why)
            replace_json(run / layout.STATUS, asdict(ended), sync=True)
            done[layout.STATUS] = f"running became stopped at step {ended.env_step}"
        if (run / layout.DIGESTS).exists() and (damaged or done):
            write_digests(run)
            for name in damaged:
                done.setdefault(name, "its digest is computed again")
    lives = reader.live().items()
    of_lives = [f"{layout.LIVE}/{name}: {line}" for name, live in lives for line in repair(live)]
    return [*(f"{name}: {what}" for name, what in done.items()), *of_lives]


def _with_digest(path: Path) -> list[str]:
    """The names of the files that have a digest, sorted."""
    recordings = layout.rrd_files(path)
    files = [file.relative_to(path) for file, _ in files_in(path) if file not in recordings]
    return sorted(name.as_posix() for name in files if name.parts[0] not in LEFT_OUT)


def _damaged(path: Path) -> dict[str, str]:
    """The files that cannot be read, or differ from what a finished run wrote, with the reason."""
    found: dict[str, str] = {}
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
                found[file.relative_to(path).as_posix()] = f"cannot be read: {reason(error)}"
    if not (path / layout.DIGESTS).exists():  # not finished
        return found
    try:
        written, there = read_json(path / layout.DIGESTS)["sha256"], _with_digest(path)
        gone = dict.fromkeys({*written} - {*there}, "is missing since the run finished")
        altered = [n for n in there if n in written and _sha256(path / n) != written[n]]
        return gone | dict.fromkeys(altered, "is not what the run wrote (sha256 differs)") | found
    except (OSError, ValueError, LookupError, TypeError) as error:
        return found | {layout.DIGESTS: f"cannot be read: {reason(error)}"}


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _kept(run: Path, place: Path) -> str:
    return f"; what was there is kept as {place.relative_to(run)}"
