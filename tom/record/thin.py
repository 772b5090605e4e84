"""Make a small copy of a run: what its pages show, in well under a megabyte. The run itself stays.

Numbers have fewer digits and series fewer points. Checkpoints and recordings are left out, large
parts of OPTIONAL unless requested, and what is not wanted of OPTIONAL and SERIES. The copy's
`config.json` lists the missing parts under `thinned`.
"""

import gzip
import re
import shlex
import shutil
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from tom.events import Collected
from tom.record import checkpoint, decode, layout
from tom.record.decode import write_table
from tom.record.files import json_line, plain, replace_json, size_of, whole_folder
from tom.record.integrity import write_digests
from tom.record.reader import THINNED, RunReader, at_or_before
from tom.record.status import Status
from tom.spread import spread

ROWS = 250  # of metrics; rows of evaluations, and EXAMS rows with exams, are kept in addition
EXAMS = 120
FITS = 60  # weight profiles
SNAPSHOTS = 3
EVALUATIONS = 3
COLUMNS = ("weight", "log_ratio")
"""of single weights, without the other terms"""
SMALL = 200_000
"""maximum size in bytes of a small part"""
DIGITS = 5
MANTISSA_BITS = 10  # of float32's 23; float16 has as many: the error is at most 0.05 %
FIRST_EPISODE = re.compile(r"^[^.]*_0(\.|$)")  # `info_0.success` is in `info_0`
PLACES = ("--store", "--out")
"""options whose values are folders of the machine that made the run"""

SERIES = ("snapshots", "evaluations")
"""parts that are thinned to a few steps, or left out whole: single weights, and episodes"""

Rounded = Callable[[NDArray], NDArray]


def thin(
    reader: RunReader, path: Path, keep: Collection[str] = (), without: Collection[str] = ()
) -> None:
    """Write a small copy of the run to `path`, which appears whole or not at all.

    Parts of OPTIONAL that are in `keep` are kept at any size. What is in `without`, of OPTIONAL or
    SERIES, is not kept.
    """
    status = reader.status  # read first, because a training may end meanwhile
    with whole_folder(path) as to:
        for folder in layout.FOLDERS:
            (to / folder).mkdir()
        for name in (layout.STATUS, layout.LABELS, layout.NOTICES, layout.SCENE):
            if (reader.path / name).is_file():
                shutil.copyfile(reader.path / name, to / name)
        rows = {layout.METRICS: _chosen_rows(reader), layout.PROFILES: _chosen_profiles(reader)}
        for name, chosen in rows.items():
            if lines := b"".join(map(json_line, chosen)):
                (to / (name + layout.PACKED)).write_bytes(gzip.compress(lines, mtime=0))
        _write_optional(reader, to, "buffer", keep, without)
        terms = not _is_missing(reader, to, "buffer")  # they explain a row's weight
        snapshots = [] if "snapshots" in without else _spread(reader.snapshot_steps(), SNAPSHOTS)
        for step in snapshots:
            frame = reader.snapshot(step)  # empty if damaged, or if a training has deleted it
            names = [n for n in frame if not n.startswith("dim_")] if terms else COLUMNS
            if len(frame):
                columns = {name: frame[name].to_numpy() for name in names if name in frame}
                write_columns(to / layout.snapshot(step), columns)
        evaluations = [] if "evaluations" in without else reader.evaluation_steps()
        for step in _spread(evaluations, EVALUATIONS):
            _copy_arrays(reader, to, layout.episodes(step), coarse, FIRST_EPISODE.search)
        for name in reader.field_names():
            recorded = reader.field_steps(name)
            for step in {at_or_before(recorded, step) for step in snapshots} | {recorded[0]}:
                _copy_arrays(reader, to, layout.field(name, step), coarse)
        for part in ("model", "policy", "policies"):
            _write_optional(reader, to, part, keep, without)
        copy = RunReader(to)
        missing = [
            *(part for part in OPTIONAL if _is_missing(reader, to, part)),
            *_other_missing_parts(reader, copy),
        ]
        before = [part for part in reader.left_out if part.removeprefix("other ") not in missing]
        description = _description(reader, dict.fromkeys([*before, *missing]))
        replace_json(to / layout.CONFIG, description, sync=False)
        if status.state in ("running", "stopped") and not reader.small_copy:
            replace_json(to / layout.STATUS, asdict(_status_of_copy(status, copy)), sync=False)
        write_digests(to)


def _status_of_copy(status: Status, copy: RunReader) -> Status:
    """The status of the copy of a run that had not finished: the copy cannot go on."""
    rows = copy.metrics()["env_step"].to_numpy()
    step = int(rows.max(initial=status.env_step))  # the rows may be later than the status
    reason = f"copied at step {step}, before its run had finished"
    return replace(status, state="stopped", phase="", env_step=step, reason=reason, eta_s=None)


def _other_missing_parts(run: RunReader, copy: RunReader) -> list[str]:
    """The parts besides OPTIONAL that the copy lacks; of `other ...` it has some."""
    snapshots, evaluations = copy.snapshot_steps(), copy.evaluation_steps()
    missing = {
        "checkpoint": checkpoint.newest(run.path / checkpoint.FOLDER) is not None,
        "recording": bool(run.rrd_files()),
        "live weights": bool(run.live()),
        "simulator states": len(copy.buffer()[0]) > 0 and bool(run.recorded().state),
    }
    for part, recorded, kept in (
        ("snapshots", run.snapshot_steps(), snapshots),
        ("policies", run.policy_steps(), copy.policy_steps()),
        ("evaluations", run.evaluation_steps(), evaluations),
    ):
        missing[f"other {part}" if kept else part] = recorded != kept
    missing |= {
        "per-dimension weights": any("dim_0" in run.snapshot(step) for step in snapshots),
        "other episodes": any(len(run.episodes(step)) > 1 for step in evaluations),
        "other pictures": any(
            run.field_steps(name) != copy.field_steps(name) for name in run.field_names()
        ),
    }
    return [part for part, is_missing in missing.items() if is_missing]


def _description(reader: RunReader, left_out: Collection[str]) -> dict[str, Any]:
    """The run's `config.json` without the folders of its machine: a copy is made to share."""
    config = {**reader.config}
    config |= {"resumes": [{**one} for one in config["resumes"]]} if "resumes" in config else {}
    for made in (config, *config.get("resumes", ())):
        if "command" in made:
            made["command"] = shlex.join(without_options(str(made["command"]), PLACES))
    return {**config, THINNED: {"left_out": list(left_out)}}


def without_options(
    command: str, options: Collection[str], flags: Collection[str] = ()
) -> list[str]:
    """The words of a shell command without these options and their values; `flags` have none.

    Raises ValueError for what is no shell command.
    """
    kept, words = [], iter(shlex.split(command))
    for word in words:
        name, given, _ = word.partition("=")
        if name not in options:
            kept.append(word)
        elif not given and name not in flags:  # the value is the next word
            next(words, None)
    return kept


def _chosen_rows(reader: RunReader) -> Iterator[dict[str, Any]]:
    table = reader.metrics()
    keep = np.full(len(table), reader.small_copy)  # a copy has no row too many
    keep[_spread(range(len(table)), ROWS)] = True
    if "eval/return" in table:
        keep |= table["eval/return"].notna().to_numpy()
    if "exam/error" in table:
        keep[_spread(np.flatnonzero(table["exam/error"].notna()).tolist(), EXAMS)] = True
    for row in table.loc[keep].to_dict("records"):
        step = int(row.pop("env_step"))
        yield {"env_step": step, **{k: short(v) for k, v in row.items() if v == v}}


def _chosen_profiles(reader: RunReader) -> Iterator[dict[str, Any]]:
    profiles = reader.profiles()
    for i in _spread(range(len(profiles.env_step)), FITS):
        yield {
            "env_step": int(profiles.env_step[i]),
            "count": int(profiles.count[i]),
            "bins": [short(value) for value in profiles.bins[i]],
            "ess": short(profiles.ess[i]),
            "zeros": short(profiles.zeros[i]),
            "rows": int(profiles.rows[i]),
        }


def write_columns(path: Path, columns: Mapping[str, NDArray]) -> None:
    """Write columns of weights as a Parquet file, rounded and strongly compressed.

    Columns of masks stay as they are.
    """
    table = pa.table({name: coarse(array) for name, array in columns.items()})
    numbers = [name for name, array in columns.items() if array.dtype != np.bool_]
    write_table(
        path, table, compression_level=19, use_dictionary=False, use_byte_stream_split=numbers
    )


def _write_buffer(reader: RunReader, to: Path) -> None:
    rows, version, _, behaviour = reader.recorded(states=False)
    if len(rows):
        known = behaviour if np.isfinite(behaviour).any() else None
        collected = Collected(0, rows, version, behaviour=known)
        arrays = decode.without_next_obs(decode.transition_arrays(collected))
        _save_arrays(to / layout.segment(0), arrays, half)


def _write_model(reader: RunReader, to: Path) -> None:
    """Write the model for predictions: networks in half precision, no optimiser."""
    held = checkpoint.load_model(reader.path)
    training = held.state.get("training", {}) if held else {}
    if held and "coefficients" in training:
        state = {"coefficients": training["coefficients"]}
    elif held and "model" in training:
        model = {name: part for name, part in training["model"].items() if name != "optimiser"}
        if "net" in model:
            model["net"] = {name: tensor.half() for name, tensor in model["net"].items()}
        state = {"model": model}
    else:
        return
    checkpoint.save(to / layout.MODEL, held.env_step, {"training": state})


def _write_policies(reader: RunReader, to: Path) -> None:
    """Write the policies of the fits whose single weights are kept, in half precision.

    All where none are kept: of a run without weights, as a recording of SAC, which is weighed at
    its policies, and in a copy without snapshots.
    """
    snapshots = RunReader(to).snapshot_steps()
    for step in reader.policy_steps():
        if not snapshots or step in snapshots:
            _copy_arrays(reader, to, layout.policy(step), half)


OPTIONAL: dict[str, tuple[str, Callable[[RunReader, Path], None]]] = {
    "buffer": (layout.BUFFER, _write_buffer),
    "model": (layout.MODEL, _write_model),
    "policy": (layout.POLICY, lambda reader, to: _copy_arrays(reader, to, layout.POLICY, half)),
    "policies": (layout.POLICIES, _write_policies),
}
"""parts that are left out if they are not small: the path and the writer of each"""


def _write_optional(
    reader: RunReader, to: Path, part: str, keep: Collection[str], without: Collection[str]
) -> None:
    """Write one of OPTIONAL, unless it is in `without`, or not small and not in `keep`."""
    name, write = OPTIONAL[part]
    if part in without:
        return
    write(reader, to)
    if part not in keep and size_of(to / name) > SMALL:
        shutil.rmtree(to / name) if (to / name).is_dir() else (to / name).unlink()


def _is_missing(reader: RunReader, to: Path, part: str) -> bool:
    """Whether the run has one of OPTIONAL and the copy has nothing of it."""
    name, fits = OPTIONAL[part][0], part == "model" and reader.fits_model
    there = size_of(reader.path / name) > 0
    there |= fits and checkpoint.model_step(reader.path) is not None  # in a checkpoint
    return there and size_of(to / name) == 0


def _copy_arrays(
    reader: RunReader,
    to: Path,
    name: str,
    rounded: Rounded,
    wanted: Callable[[str], object] = lambda name: True,
) -> None:
    """Copy the `wanted` arrays of a file, rounded."""
    arrays = reader.arrays(name, lambda array: bool(wanted(array)))
    if arrays is not None:  # else missing or damaged, which `tom runs verify` reports
        _save_arrays(to / name, arrays, rounded)


def _save_arrays(path: Path, arrays: Mapping[str, NDArray], rounded: Rounded) -> None:
    content = {name: rounded(array) for name, array in arrays.items()}
    np.savez_compressed(path, allow_pickle=False, **content)


def _spread(items: Sequence[int], most: int) -> list[int]:
    """At most `most` of `items`, evenly, with the first and the last."""
    return [items[i] for i in spread(len(items), most)]


def short(value: Any) -> Any:
    """A JSON number rounded to DIGITS digits; other values are unchanged."""
    number = plain(value)
    return float(f"{number:.{DIGITS}g}") if isinstance(number, float) else number


def coarse(array: NDArray) -> NDArray:
    """Floats rounded to MANTISSA_BITS as float32; other arrays are unchanged."""
    if not np.issubdtype(array.dtype, np.floating):
        return array
    single = np.array(array, np.float32, order="C")
    cut = 23 - MANTISSA_BITS
    bits = single.view(np.uint32).astype(np.uint64) + (1 << (cut - 1))  # round, not truncate
    rounded = ((bits >> cut) << cut).astype(np.uint32).view(np.float32)
    return np.where(np.isfinite(single), rounded, single)


def half(array: NDArray) -> NDArray:
    """Floats as float16 if all fit its range, else `coarse`; other arrays are unchanged.

    Near zero (below 6e-5) the error is at most 3e-8 instead of 0.05 %.
    """
    if not np.issubdtype(array.dtype, np.floating):
        return array
    largest = np.abs(array, where=np.isfinite(array), out=np.zeros_like(array)).max(initial=0)
    return array.astype(np.float16) if largest <= np.finfo(np.float16).max else coarse(array)
