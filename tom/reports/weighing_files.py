"""What a weighing leaves behind: weights, profiles, figure and report, all of them or nothing."""

import csv
import os
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from tom.analysis.ordered_data import OrderedData
from tom.analysis.progression import medians, progression
from tom.analysis.weighing import Weighed
from tom.data.sampling import bin_means
from tom.errors import UserError
from tom.learners import LEARNERS
from tom.record import layout
from tom.record.array_files import DAMAGE, read_table
from tom.record.files import read_json, replace_json, whole_folder
from tom.record.thin import write_columns
from tom.reports.profile_figure import Panel, profile_figure
from tom.reports.style import save

WEIGHTS, PROFILE, REPORT, FIGURE = "weights.parquet", "profile.csv", "report.json", "profile"
LOG_RATIO = "-log_ratio"
"""ends the name of a column that holds the discriminator's output beside the weights"""
MATCH = ("footprint", "footprint_se", "footprint_noise", "footprint_uniform")
"""how near the weighted data is to fresh episodes of the policy; null where it cannot be said"""
NEEDED = {"data", "policy", "rows", "results"}
"""the files a report must have"""


def of_run(store: Path, run_id: str) -> list[Path]:
    """The weighings in `store` of the buffer of a run, by name; unreadable ones are left out."""
    found = sorted(path.parent for path in (store / layout.WEIGHINGS).glob(f"*/{REPORT}"))
    return [path for path in found if path.name[0] != "." and _data(path) == run_id]


def copy_small(store: Path, run_id: str, to: Path) -> Iterator[Path]:
    """Copy the weighings of a run into the store `to`, the weights rounded, log ratios left out.

    Yields each copy. Raises UserError for one that is there already, is damaged or cannot be
    written.
    """
    for path in of_run(store, run_id):
        copy = to / layout.WEIGHINGS / path.name
        check_free(copy)
        weights = _read_weights(path)
        with _whole(copy) as unfinished:
            for file in path.iterdir():
                if file.name != WEIGHTS and file.is_file() and not file.is_symlink():
                    shutil.copyfile(file, unfinished / file.name)
            write_columns(unfinished / WEIGHTS, weights)
        yield copy


def check_free(out: Path) -> None:
    """Raises UserError when `out` holds something already or cannot be made."""
    if out.is_dir() and not any(out.iterdir()):
        return
    if os.path.lexists(out):
        raise UserError(f"{out} exists already: name another folder with --out")
    parent = next(p for p in out.absolute().parents if p.exists())
    if not parent.is_dir() or not os.access(parent, os.W_OK | os.X_OK):
        raise UserError(f"cannot make {out} in {parent}: name another folder with --out")


def summary(data: OrderedData, found: Sequence[Weighed]) -> dict[str, Any]:
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
        for one in found
    ]
    return {
        "data": data.name,
        "env": data.env,
        "rows": len(data),
        "ordered_from": data.ordered_from,
        "results": results,
        "medians": {
            name: medians([progression(one.weights, data.ordered_from) for one in of])
            for name, of in by_learner(found).items()
        },
    }


def by_learner(found: Sequence[Weighed]) -> dict[str, list[Weighed]]:
    """The results of each learner, in the order of first appearance."""
    groups: dict[str, list[Weighed]] = {}
    for one in found:
        groups.setdefault(one.learner, []).append(one)
    return groups


def profiles(of: Sequence[Weighed], bins: int) -> NDArray[np.float64]:
    """The weight profiles of several seeds, (S, bins)."""
    return np.stack([bin_means(one.weights, bins).numpy() for one in of])


def write(
    out: Path, data: OrderedData, found: Sequence[Weighed], bins: int, report: dict[str, Any]
) -> None:
    """Make the folder `out` with everything in it. Raises UserError when it cannot be made."""
    with _whole(out) as unfinished:
        write_weights(unfinished / WEIGHTS, found)
        write_profiles(unfinished / PROFILE, found, bins)
        panels = [
            Panel(LEARNERS[name].label, name, profiles(of, bins))
            for name, of in by_learner(found).items()
        ]
        share = data.ordered_from / len(data)
        save(profile_figure({data.name: panels}, {data.name: share}), unfinished, FIGURE)
        replace_json(unfinished / REPORT, report, sync=False)


@contextmanager
def _whole(out: Path) -> Iterator[Path]:
    """`whole_folder` with a UserError where it cannot be written."""
    try:
        with whole_folder(out.absolute()) as unfinished:
            yield unfinished
    except OSError as error:
        raise UserError(
            f"cannot write {out}: {error.strerror or error}; name another --out"
        ) from error


def _data(path: Path) -> str | None:
    try:
        report = read_json(path / REPORT)
    except (OSError, ValueError):
        return None
    return str(report["data"]) if report.keys() >= NEEDED else None


def _read_weights(path: Path) -> dict[str, NDArray[np.float32]]:
    """The weights of a weighing by learner and seed, without log ratios."""
    try:
        table = read_table(path / WEIGHTS)
    except DAMAGE as error:
        raise UserError(f"weighing {path} cannot be read ({error}): move it away") from error
    kept = [name for name in table if not name.endswith(LOG_RATIO)]
    return {name: table[name].to_numpy() for name in kept}


def write_weights(path: Path, found: Sequence[Weighed]) -> None:
    """One float32 column for each learner and seed, a row a transition, oldest first."""
    columns: dict[str, NDArray[np.float32]] = {}
    for one in found:
        columns[f"{one.learner}-s{one.seed}"] = one.weights
        if one.log_ratio is not None:
            columns[f"{one.learner}-s{one.seed}{LOG_RATIO}"] = one.log_ratio
    pq.write_table(
        pa.table(columns), path, compression="zstd", use_dictionary=False,
        use_byte_stream_split=True,
    )  # fmt: skip


def write_profiles(path: Path, found: Sequence[Weighed], bins: int) -> None:
    """A line for each learner, seed and bin (0 is the oldest): its mean weight."""
    with path.open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(["learner", "seed", "bin", "mean_weight"])
        for one in found:
            for number, mean in enumerate(bin_means(one.weights, bins).tolist()):
                table.writerow([one.learner, one.seed, number, f"{mean:.6g}"])
