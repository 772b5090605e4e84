"""Make a small copy of a run: what its pages show, in well under a megabyte. The run itself stays.

Numbers have fewer digits and series fewer points. Checkpoints and recordings are left out, large
parts of OPTIONAL unless requested, and what is not wanted of OPTIONAL and SERIES. The copy's
`config.json` lists the missing parts under `thinned`.
"""

import json
import shutil
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from tom.record import checkpoint, decode, digests, layout, small_copy
from tom.record.array_files import write_table
from tom.record.decode import Profiles
from tom.record.files import plain, replace_json, size_of, whole_folder
from tom.record.reader import RunReader, at_or_before
from tom.record.status import Status

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
SHRINKS = 20
"""smallest share to which a part can shrink; larger parts are not even tried"""


Rounded = Callable[[NDArray], NDArray]

SERIES = ("snapshots", "evaluations")
"""parts that are thinned to a few steps, or left out whole: single weights, and episodes"""


def thin(
    reader: RunReader, path: Path, keep: Collection[str] = (), without: Collection[str] = ()
) -> None:
    """Write a small copy of the run to `path`, which appears whole or not at all.

    Parts of OPTIONAL that are in `keep` are kept at any size. What is in `without`, of OPTIONAL or
    SERIES, is not kept.
    """
    status = reader.status  # read first, because a training may end meanwhile
    with whole_folder(path) as unfinished:
        for folder in layout.FOLDERS:
            (unfinished / folder).mkdir()
        _copy(reader, unfinished, without)
        lacks = [part for part in OPTIONAL if _leave_out(reader, unfinished, part, keep, without)]
        if "buffer" not in lacks:  # else no page has the row whose weight the terms explain
            for step in RunReader(unfinished).snapshot_steps():
                _snapshot(reader, step, unfinished, terms=True)
        lost_parts = _lost(reader, RunReader(unfinished))
        lacks += [part for part, lost in lost_parts.items() if lost]
        before = [part for part in reader.left_out if part.removeprefix("other ") not in lacks]
        left_out = dict.fromkeys([*before, *lacks])
        replace_json(unfinished / layout.CONFIG, _description(reader, left_out), sync=False)
        if status.state in ("running", "stopped") and not reader.small_copy:
            _settle(status, unfinished)
        digests.write(unfinished)


def _settle(status: Status, copy: Path) -> None:
    """Write the copy's status, for a run that had not ended with `status`."""
    rows = RunReader(copy).metrics()["env_step"].to_numpy()  # may be later than the status
    settled = small_copy.status_of(status, int(rows.max(initial=status.env_step)))
    replace_json(copy / layout.STATUS, asdict(settled), sync=False)


def _copy(reader: RunReader, to: Path, without: Collection[str]) -> None:
    for name in (layout.STATUS, layout.LABELS, layout.NOTICES, layout.SCENE):
        if (reader.path / name).is_file():
            shutil.copyfile(reader.path / name, to / name)
    _lines(to / layout.METRICS, _chosen_rows(reader))
    _lines(to / layout.PROFILES, _profile_rows(reader.profiles()))
    snapshots = [] if "snapshots" in without else _spread(reader.snapshot_steps(), SNAPSHOTS)
    evaluations = [] if "evaluations" in without else reader.evaluation_steps()
    for step in snapshots:
        _snapshot(reader, step, to, terms=False)
    for step in _spread(evaluations, EVALUATIONS):
        _arrays(reader, to, layout.episodes(step), coarse, first_episode=True)
    for name in reader.field_names():
        for step in _beside(reader.field_steps(name), snapshots):
            _arrays(reader, to, layout.field(name, step), coarse)


def _lost(run: RunReader, copy: RunReader) -> dict[str, bool]:
    """The parts besides OPTIONAL that the copy lacks; `other`: it has some of them."""
    snapshots, evaluations = copy.snapshot_steps(), copy.evaluation_steps()
    fields, other_snapshots = run.field_names(), run.snapshot_steps() != snapshots
    other_evaluations = run.evaluation_steps() != evaluations
    return {
        "checkpoint": checkpoint.newest(run.path / checkpoint.FOLDER) is not None,
        "recording": bool(run.rrd_files()),
        "simulator states": len(copy.buffer()[0]) > 0 and bool(run.recorded().state),
        "snapshots": other_snapshots and not snapshots,
        "other snapshots": other_snapshots and bool(snapshots),
        "other policies": 0 < len(copy.policy_steps()) < len(run.policy_steps()),
        "per-dimension weights": any("dim_0" in run.snapshot(step) for step in snapshots),
        "evaluations": other_evaluations and not evaluations,
        "other evaluations": other_evaluations and bool(evaluations),
        "other episodes": any(len(run.episodes(step)) > 1 for step in evaluations),
        "other pictures": any(run.field_steps(name) != copy.field_steps(name) for name in fields),
    }


def _description(reader: RunReader, left_out: Collection[str]) -> dict[str, Any]:
    note = {
        "rows_of_metrics": ROWS,
        "profiles": FITS,
        "snapshots": SNAPSHOTS,
        "evaluations": EVALUATIONS,
        "episodes_of_an_evaluation": 1,
        "left_out": list(left_out),
    }
    return {**small_copy.described(reader.config), small_copy.KEY: note}


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


def _profile_rows(profiles: Profiles) -> Iterator[dict[str, Any]]:
    for i in _spread(range(len(profiles.env_step)), FITS):
        yield {
            "env_step": int(profiles.env_step[i]),
            "count": int(profiles.count[i]),
            "bins": [short(value) for value in profiles.bins[i]],
            "ess": short(profiles.ess[i]),
            "zeros": short(profiles.zeros[i]),
        }


def _snapshot(reader: RunReader, step: int, to: Path, *, terms: bool) -> None:
    """Write the weights of a fit, without those of dimensions."""
    frame = reader.snapshot(step)
    if not len(frame):  # damaged, or a training has deleted it since
        return
    wanted = [name for name in frame if not name.startswith("dim_")] if terms else COLUMNS
    columns = {name: frame[name].to_numpy() for name in wanted if name in frame}
    write_columns(to / layout.snapshot(step), columns)


def write_columns(path: Path, columns: Mapping[str, NDArray]) -> None:
    """Write columns of weights as a Parquet file, rounded and strongly compressed.

    Columns of masks stay as they are.
    """
    table = pa.table({name: coarse(array) for name, array in columns.items()})
    numbers = [name for name, array in columns.items() if array.dtype != np.bool_]
    write_table(
        path, table, compression_level=19, use_dictionary=False, use_byte_stream_split=numbers
    )


def _buffer(reader: RunReader, to: Path) -> None:
    rows, version = reader.buffer()
    if len(rows):
        arrays = decode.without_next_obs(decode.transition_arrays(rows, version))
        _save(to / layout.segment(0), arrays, half)


def _model(reader: RunReader, to: Path) -> None:
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


def _policy(reader: RunReader, to: Path) -> None:
    _arrays(reader, to, layout.POLICY, half)


def _policies(reader: RunReader, to: Path) -> None:
    """Write the policies of the fits whose single weights are kept, in half precision.

    All where none are kept: of a run without weights, as a recording of SAC, which is weighed at
    its policies, and in a copy without snapshots.
    """
    beside = RunReader(to).snapshot_steps()
    for step in reader.policy_steps():
        if not beside or step in beside:
            _arrays(reader, to, layout.policy(step), half)


OPTIONAL: dict[str, tuple[str, Callable[[RunReader, Path], None]]] = {
    "buffer": ("buffer", _buffer),
    "model": (layout.MODEL, _model),
    "policy": (layout.POLICY, _policy),
    "policies": (layout.POLICIES, _policies),
}
"""parts that are left out if they are not small: the path and the writer of each"""


def _leave_out(
    reader: RunReader, to: Path, part: str, keep: Collection[str], without: Collection[str]
) -> bool:
    """Write one of OPTIONAL; returns True if the run has it, but the copy will not.

    That is, if it is in `without`, or if it is not small and not in `keep`.
    """
    name, write = OPTIONAL[part]
    if part in without:
        in_checkpoint = part == "model" and reader.fits_model
        kept = in_checkpoint and checkpoint.model_step(reader.path) is not None
        return kept or _bytes(reader.path / name) > 0
    hopeless = _bytes(reader.path / name) > SHRINKS * SMALL
    if hopeless and part not in keep:
        return True
    write(reader, to)
    if part in keep or _bytes(to / name) <= SMALL:
        return False
    shutil.rmtree(to / name) if (to / name).is_dir() else (to / name).unlink()
    return True


def _bytes(path: Path) -> int:
    return path.stat().st_size if path.is_file() else size_of(path)


def _arrays(
    reader: RunReader, to: Path, name: str, rounded: Rounded, *, first_episode: bool = False
) -> None:
    """Copy the arrays of a file, rounded, or only those of its first episode."""

    def wanted(array: str) -> bool:
        return not first_episode or array.partition(".")[0].endswith("_0")  # info_0.success: info_0

    arrays = reader.arrays(name, wanted)
    if arrays is not None:  # else missing or damaged, which `tom runs verify` reports
        _save(to / name, arrays, rounded)


def _save(path: Path, arrays: Mapping[str, NDArray], rounded: Rounded) -> None:
    content = {name: rounded(array) for name, array in arrays.items()}
    np.savez_compressed(path, allow_pickle=False, **content)


def _spread(items: Sequence[int], most: int) -> list[int]:
    """At most `most` of `items`, evenly, with the first and the last."""
    if len(items) <= most:
        return list(items)
    return [items[i] for i in np.linspace(0, len(items) - 1, most).round().astype(int)]


def _beside(recorded: Sequence[int], snapshots: Sequence[int]) -> list[int]:
    """The steps of `recorded` that belong to a snapshot: the last not after it, else the first."""
    return sorted({at_or_before(recorded, step) for step in snapshots} | {recorded[0]})


def _lines(path: Path, rows: Iterable[dict[str, Any]]) -> None:
    text = "".join(json.dumps(plain(row), separators=(",", ":")) + "\n" for row in rows)
    path.write_text(text)


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
