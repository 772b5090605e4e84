"""The files of a weighing: weights, profiles, figure and report, written atomically.

Rows that no run of the store holds are included, as in a run folder (`buffer/`, `config.json`).
"""

import csv
import hashlib
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from tom.analysis.brush import AS_IT_IS, BrushedFit
from tom.analysis.ordered_data import OrderedData
from tom.analysis.progression import medians, progression
from tom.analysis.weighing import Weighed, WeighingPlan, setting_groups
from tom.data.sampling import bin_means
from tom.errors import UserError
from tom.learners import LEARNERS
from tom.record import decode, layout
from tom.record.array_files import DAMAGE, NUMBERS, read_table, write_table
from tom.record.files import read_json, replace_json, whole_folder
from tom.record.store import Store
from tom.record.task_record import description, save_scene
from tom.record.thin import write_columns
from tom.record.versions import git_commit, versions
from tom.reports.report import seeds

WEIGHTS, PROFILE, REPORT, FIGURE = "weights.parquet", "profile.csv", "report.json", "profile"
LOG_RATIO = "-log_ratio"
"""suffix of the column of the discriminator's output"""
MATCH = ("footprint", "footprint_se", "footprint_noise", "footprint_uniform")
"""the match of the weighted data to fresh episodes of the policy; null if not measured"""
NEEDED = {"data", "policy", "rows", "results"}
"""the required entries of a report"""
BRUSH = "brush"
"""entry of the report of `tom brush`"""
ROWS = "rows_digest"
"""entry of a report whose weighing holds its rows: their digest"""
SEGMENT_BYTES = 64 * 2**20
"""bytes of rows per file"""


def of_run(store: Path, run_id: str) -> list[Path]:
    """The weighings of a run's buffer in `store`, by name; unreadable ones are left out."""
    return [
        path for path, report in reports(store) if report["data"] == run_id and ROWS not in report
    ]


def reports(store: Path) -> list[tuple[Path, dict[str, Any]]]:
    """Every weighing in `store` with its report, by name; unreadable ones are left out."""
    read = [(path, _report(path)) for path in folders(store)]
    return [(path, report) for path, report in read if report is not None]


def folders(store: Path) -> list[Path]:
    """The folders of weighings in `store`, by name; links are left out, also one to all of them."""
    try:
        held = sorted(Store(store).beside(layout.WEIGHINGS).glob(f"*/{REPORT}"))
    except UserError:
        return []
    paths = [report.parent for report in held]
    return [path for path in paths if path.name[0] != "." and not path.is_symlink()]


def copy_small(store: Path, run_id: str, to: Path) -> Iterator[Path]:
    """Copy the weighings of a run into the store `to`, with rounded weights and without terms.

    Their figure comes along as PNG alone. Yields each copy. Raises UserError if one exists already,
    is damaged or cannot be written.
    """
    for path in of_run(store, run_id):
        copy = Store(to).beside(layout.WEIGHINGS) / path.name
        check_free(copy)
        weights = _read_weights(path)
        with whole_weighing(copy) as unfinished:
            for file in path.iterdir():
                left_out = file.name == WEIGHTS or file.suffix == ".svg"
                if not left_out and file.is_file() and not file.is_symlink():
                    shutil.copyfile(file, unfinished / file.name)
            write_columns(unfinished / WEIGHTS, weights)
        yield copy


def check_free(out: Path) -> None:
    """Raises UserError if `out` is not empty or cannot be made."""
    if out.is_dir() and not any(out.iterdir()):
        return
    if os.path.lexists(out):
        raise UserError(f"{out} exists already: name another folder with --out")
    parent = next(p for p in out.absolute().parents if p.exists())
    if not parent.is_dir() or not os.access(parent, os.W_OK | os.X_OK):
        raise UserError(f"cannot make {out} in {parent}: name another folder with --out")


def summary(data: OrderedData, weighed: Sequence[Weighed]) -> dict[str, Any]:
    """The report on all learners and seeds, ready for JSON."""
    results = [
        {
            "learner": one.learner,
            "seed": one.seed,
            **progression(one.weights, data.ordered_from).row(),
            **{name: one.match.get(name) for name in MATCH},
            "footprint_return": one.footprint_return,
            "metrics": one.metrics,
            "notices": [message for _, message in one.notices],
        }
        for one in weighed
    ]
    return {
        "data": data.name,
        "env": data.env,
        "rows": len(data),
        "ordered_from": data.ordered_from,
        **({} if data.stored else {ROWS: rows_digest(data)}),
        "results": results,
        "medians": {
            name: medians([progression(one.weights, data.ordered_from) for one in of])
            for name, of in by_learner(weighed).items()
        },
    }


def report(
    plan: WeighingPlan,
    weighed: Sequence[Weighed],
    policy: str,
    step: int | None,
    command: str,
    hours: float,
) -> dict[str, Any]:
    """The content of `report.json` for a plan that `command` carried out in `hours`."""
    return {
        "policy": policy,
        "step": step,
        "preset": plan.preset,
        "changed": dict(plan.changed),
        "footprint": plan.footprint,
        "config": plan.config.model_dump(include=setting_groups()),
        **summary(plan.data, weighed),
        "made": {
            "command": command,
            "git_commit": git_commit(),
            "versions": versions(),
            "hours": hours,
        },
    }


def notices(report: Mapping[str, Any]) -> list[str]:
    """What the learners noticed about their weights, each once with the seeds of which it holds."""
    held: dict[tuple[str, str], list[int]] = {}
    for result in report["results"]:
        for message in result.get("notices", ()):
            held.setdefault((result["learner"], message), []).append(result["seed"])
    return [
        f"{LEARNERS[name].label if name in LEARNERS else name}, seed {seeds(of)}: {message}"
        for (name, message), of in held.items()
    ]


def by_learner(weighed: Sequence[Weighed]) -> dict[str, list[Weighed]]:
    """The results of each learner, in the order of first appearance."""
    groups: dict[str, list[Weighed]] = {}
    for one in weighed:
        groups.setdefault(one.learner, []).append(one)
    return groups


def profiles(of: Sequence[Weighed], bins: int) -> NDArray[np.float64]:
    """The weight profiles of several seeds, (S, bins)."""
    return np.stack([bin_means(one.weights, bins).numpy() for one in of])


def write(
    out: Path, data: OrderedData, weighed: Sequence[Weighed], bins: int, report: dict[str, Any]
) -> None:
    """Make the folder `out` with all files. Raises UserError if it cannot be made."""
    with whole_weighing(out) as unfinished:
        write_weights(unfinished / WEIGHTS, weighed)
        write_profiles(unfinished / PROFILE, weighed, bins)
        if not data.stored:
            _write_rows(unfinished, data)
        _draw(unfinished, data, weighed, bins)
        replace_json(unfinished / REPORT, report, sync=False)


def _draw(folder: Path, data: OrderedData, weighed: Sequence[Weighed], bins: int) -> None:
    # Imported here, so that listing runs does not load matplotlib.
    from tom.reports.figures import Panel, profile_figure, save

    panels = [
        Panel(LEARNERS[name].label, name, profiles(of, bins))
        for name, of in by_learner(weighed).items()
    ]
    share = data.ordered_from / len(data)
    save(profile_figure({data.name: panels}, {data.name: share}), folder, FIGURE)


@contextmanager
def place(out: Path | None, store: Store, name: str) -> Iterator[Path]:
    """The folder of a new weighing: `out`, else one in the store that the block fills.

    It is chosen when its content is there: a name that was free when the work began may be taken by
    another's that began in the same second. After an error nothing of it remains.
    """
    if out is not None:
        yield out
        return
    try:
        made = store.make_weighing(name)
    except OSError as error:
        raise UserError(f"cannot write into {store.path}: {error.strerror}; name --out") from error
    try:
        yield made
    except BaseException:
        with suppress(OSError):
            made.rmdir()
        raise


@contextmanager
def whole_weighing(out: Path) -> Iterator[Path]:
    """`whole_folder` that raises UserError if it cannot be written."""
    try:
        with whole_folder(out.absolute()) as unfinished:
            yield unfinished
    except OSError as error:
        raise UserError(
            f"cannot write {out}: {error.strerror or error}; name another --out"
        ) from error


def rows_digest(data: OrderedData) -> str:
    """A digest of the rows of `data`, eight characters."""
    packed = data.transitions.packed().numpy()
    return hashlib.sha256(packed.tobytes()).hexdigest()[:8]


def _write_rows(folder: Path, data: OrderedData) -> None:
    rows, version = data.transitions.numpy(), data.policy_version.numpy()
    width = 4 * (2 * np.shape(rows.obs)[1] + np.shape(rows.action)[1] + 5)
    at_once = max(SEGMENT_BYTES // width, 1)
    (folder / layout.segment(0)).parent.mkdir()
    for first in range(0, len(rows), at_once):
        part = slice(first, first + at_once)
        arrays = decode.transition_arrays(rows[part], version[part])
        np.savez(folder / layout.segment(first), allow_pickle=False, **arrays)
    # Readers of runs find the task there.
    assert data.env is not None
    said = {"schema": layout.SCHEMA, "env": data.env, "task": description(data.env)}
    # For those who weigh these rows from here.
    said |= {"data": data.name, "ordered_from": data.ordered_from}
    replace_json(folder / layout.CONFIG, said, sync=False)
    save_scene(data.env, folder)


def _report(path: Path) -> dict[str, Any] | None:
    try:
        report = read_json(path / REPORT)
    except (OSError, ValueError):
        return None
    return report if is_whole(report) else None


def is_whole(report: Mapping[str, Any]) -> bool:
    """Whether a report has what its readers need, each entry of its type."""
    if not report.keys() >= NEEDED or not isinstance(report["results"], list):
        return False
    said = report["data"], report["policy"]
    return (
        all(isinstance(name, str) for name in said)
        and isinstance(report["rows"], int)
        and all(map(_is_result, report["results"]))
        and _is_origin(report.get("made", {}))
    )


def is_brush(report: Mapping[str, Any]) -> bool:
    """Whether the weights are a what-if (`tom brush`), a learner's multiplied in a region."""
    return BRUSH in report


def _is_result(row: object) -> bool:
    """Whether it says whose weights these are, and what there is to notice in words."""
    if not isinstance(row, dict):
        return False
    said = row.get("notices", [])
    told = isinstance(said, list) and all(isinstance(message, str) for message in said)
    return told and isinstance(row.get("learner"), str) and isinstance(row.get("seed"), int)


def _is_origin(made: object) -> bool:
    """Whether it can say how a weighing was made; an old one says little."""
    if not isinstance(made, dict) or not isinstance(made.get("versions", {}), dict):
        return False
    hours = made.get("hours", 0.0)
    return isinstance(hours, (float, int))


def _read_weights(path: Path) -> dict[str, NDArray]:
    """The weights of a weighing by learner and seed, without their terms; a brush's region, too."""
    try:
        table = read_table(path / WEIGHTS)
    except DAMAGE as error:
        raise UserError(f"weighing {path} cannot be read ({error}): move it away") from error
    kept = [
        name
        for name in map(str, table)
        if name.rpartition("-s")[2].isdigit() or table[name].dtype == np.bool_
    ]
    return {name: table[name].to_numpy() for name in kept}


def write_weights(path: Path, weighed: Sequence[Weighed]) -> None:
    """One float32 column for each learner and seed, one row per transition, oldest first.

    If a learner has terms, they are further columns (`LEARNER-sSEED-TERM`).
    """
    columns: dict[str, NDArray[np.float32]] = {}
    for one in weighed:
        columns[f"{one.learner}-s{one.seed}"] = one.weights
        if one.log_ratio is not None:
            columns[f"{one.learner}-s{one.seed}{LOG_RATIO}"] = one.log_ratio
        for name, term in one.terms.items():
            columns[f"{one.learner}-s{one.seed}-{name}"] = term
    write_table(path, pa.table(columns), **NUMBERS)


def write_profiles(path: Path, weighed: Sequence[Weighed], bins: int) -> None:
    """One line for each learner, seed and bin (0 is the oldest) with the mean weight."""
    with path.open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(["learner", "seed", "bin", "mean_weight"])
        for one in weighed:
            for number, mean in enumerate(bin_means(one.weights, bins).tolist()):
                table.writerow([one.learner, one.seed, number, f"{mean:.6g}"])


GHOSTS = "ghosts.npz"
REGION = "region"
"""the column that marks the brushed rows"""


def called(factor: float) -> str:
    """The name of weights of that factor, used in place of a learner's name."""
    return "as it is" if factor == AS_IT_IS else f"region x {factor:g}"


def write_brush(
    out: Path,
    region: NDArray[np.bool_],
    models: Sequence[BrushedFit],
    report: dict[str, Any],
    ghosts: Mapping[str, NDArray],
) -> None:
    """Make the folder `out` with all files. Raises UserError if it cannot be made."""
    # The weights do not depend on the seed.
    first = {one.factor: one for one in reversed(models)}
    columns = {f"{called(f)}-s{one.seed}": one.weights for f, one in sorted(first.items())}
    results = [
        {
            "learner": called(one.factor),
            "factor": one.factor,
            "seed": one.seed,
            "errors": one.errors,
            **progression(one.weights, report["ordered_from"]).row(),
        }
        for one in models
    ]
    with whole_weighing(out) as unfinished:
        table = pa.table({**columns, REGION: region})
        write_table(unfinished / WEIGHTS, table)
        if ghosts:
            np.savez_compressed(unfinished / GHOSTS, allow_pickle=False, **dict(ghosts))
        replace_json(unfinished / REPORT, {**report, "results": results}, sync=False)
