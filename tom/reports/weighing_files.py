"""The files of a weighing: weights, profiles, figure and report, written atomically.

Rows that no run of the store holds are included, as in a run folder (`buffer/`, `config.json`).
A brushed region is a weighing as well, with the models' errors and ghosts.
"""

import hashlib
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from tom.analysis.brush import UNCHANGED, BrushedFit
from tom.analysis.ordered_data import OrderedData
from tom.analysis.progression import medians, progression
from tom.analysis.weighing import Weighed, WeighingPlan, setting_groups
from tom.data.card import Card
from tom.data.sampling import bin_means
from tom.data.unpack import DAMAGE
from tom.errors import UserError
from tom.events import Collected
from tom.learners import LEARNERS
from tom.record import decode, layout
from tom.record.decode import NUMBERS, read_table, write_table
from tom.record.files import read_json, replace_json, whole_folder
from tom.record.store import Store
from tom.record.task_record import description, save_scene
from tom.record.thin import write_columns
from tom.record.versions import made_by
from tom.reports.report import in_short, write_csv

WEIGHTS, PROFILE, REPORT, FIGURE = "weights.parquet", "profile.csv", layout.REPORT, "profile"
SAME = 1e-6
"""weights of mean 1 that differ by no more are the same"""
GHOSTS = "ghosts.npz"
REGION = "region"
"""the column that marks the brushed rows"""
DISTANCE = "policy_distance"
"""the column of the distances to the policy (`tom.policy.stored.distances`)"""
LOG_RATIO = "-log_ratio"
"""suffix of the column of the discriminator's output"""
MATCH = ("footprint", "footprint_se", "footprint_noise", "footprint_uniform")
"""the match of the weighted data to fresh episodes of the policy; null if not measured"""
BRUSH = "brush"
"""entry of the report of `tom brush`"""
ROWS = "rows_digest"
"""entry of a report whose weighing holds its rows: their digest"""


# Read.


def read_report(path: Path) -> dict[str, Any]:
    """The report of the weighing in the folder `path`. Raises OSError, or ValueError if damaged.

    `end` is the number of the row after the last weighed one, in the run's record or the folder's.
    """
    report = read_json(path / REPORT)
    if lacking := {"data", "policy", "rows", "results"}.difference(report):
        raise ValueError(f"the report has no {' and no '.join(sorted(lacking))}")
    older = report["rows"] if ROWS in report else report.get("step") or report["rows"]
    return {"end": older, **report}


def reports(store: Path) -> list[tuple[Path, dict[str, Any]]]:
    """Every weighing in `store` with its report, by name; unreadable ones are left out."""
    found = []
    for path in folders(store):
        with suppress(OSError, ValueError):
            found.append((path, read_report(path)))
    return found


def folders(store: Path) -> list[Path]:
    """The folders of weighings in `store`, by name; links are left out, also one to all of them."""
    try:
        held = sorted(Store(store).beside(layout.WEIGHINGS).glob(f"*/{REPORT}"))
    except UserError:
        return []
    paths = [report.parent for report in held]
    return [path for path in paths if path.name[0] != "." and not path.is_symlink()]


def of_run(store: Path, run_id: str) -> list[Path]:
    """The weighings of a run's buffer in `store`, by name; unreadable ones are left out."""
    return [
        path for path, report in reports(store) if report["data"] == run_id and ROWS not in report
    ]


def is_brush(report: Mapping[str, Any]) -> bool:
    """Whether the weights are a what-if (`tom brush`), a learner's multiplied in a region."""
    return BRUSH in report


def notices(report: Mapping[str, Any]) -> list[str]:
    """What contradicts itself, and what the learners noticed about their weights.

    Each once; a learner's with the seeds of which it holds.
    """
    noticed: dict[tuple[str, str], list[int]] = {}
    for result in report["results"]:
        for message in result.get("notices", ()):
            noticed.setdefault((result["learner"], message), []).append(result["seed"])
    of_card = [str(notice["text"]) for notice in report.get("card", {}).get("notices", ())]
    return of_card + [
        f"{LEARNERS[name].label if name in LEARNERS else name}, seed {in_short(of)}: {message}"
        for (name, message), of in noticed.items()
    ]


# Where a weighing goes.


def check_free(out: Path) -> None:
    """Raises UserError if `out` is not empty or cannot be made."""
    if out.is_dir() and not any(out.iterdir()):
        return
    if os.path.lexists(out):
        raise UserError(f"{out} exists already: name another folder with --out")
    parent = next(p for p in out.absolute().parents if p.exists())
    if not parent.is_dir() or not os.access(parent, os.W_OK | os.X_OK):
        raise UserError(f"cannot make {out} in {parent}: name another folder with --out")


@contextmanager
def _unfinished(out: Path) -> Iterator[Path]:
    """A folder that becomes `out` at the end of the block. Raises UserError if it cannot be."""
    try:
        with whole_folder(out.absolute()) as folder:
            yield folder
    except OSError as error:
        why = error.strerror or error
        raise UserError(f"cannot write {out}: {why}; name another --out") from error


def copy_small(store: Path, run_id: str, to: Path) -> Iterator[Path]:
    """Copy the weighings of a run into the store `to`, with rounded weights and without terms.

    Their figure comes along as PNG alone. Yields each copy. Raises UserError if one exists already,
    is damaged or cannot be written.
    """
    for path in of_run(store, run_id):
        copy = Store(to).beside(layout.WEIGHINGS) / path.name
        check_free(copy)
        try:
            table = read_table(path / WEIGHTS)
        except DAMAGE as error:
            raise UserError(f"weighing {path} cannot be read ({error}): move it away") from error
        kept = {
            name: table[name].to_numpy()
            for name in map(str, table)
            if name.rpartition("-s")[2].isdigit()
            or name == DISTANCE
            or table[name].dtype == np.bool_
        }
        with _unfinished(copy) as folder:
            for file in path.iterdir():
                left_out = file.name == WEIGHTS or file.suffix == ".svg"
                if not left_out and file.is_file() and not file.is_symlink():
                    shutil.copyfile(file, folder / file.name)
            write_columns(folder / WEIGHTS, kept)
        yield copy


# Write.


def report(
    plan: WeighingPlan,
    weighed: Sequence[Weighed],
    policy: str,
    step: int | None,
    command: str,
    hours: float,
) -> dict[str, Any]:
    """The content of `report.json` for a plan that `command` carried out in `hours`."""
    data = plan.data
    shapes = [progression(one.weights, data.ordered_from) for one in weighed]
    by_learner: dict[str, list[dict[str, Any]]] = {}
    for one, shape in zip(weighed, shapes, strict=True):
        by_learner.setdefault(one.learner, []).append(shape)
    return {
        "policy": policy,
        "step": step,
        "preset": plan.preset,
        "changed": dict(plan.changed),
        "footprint": plan.footprint,
        "config": plan.config.model_dump(include=setting_groups()),
        "data": data.name,
        "env": data.env,
        "rows": len(data),
        "end": len(data) if data.run is None else data.end,
        "card": card(data.card, weighed).described(),
        "ordered_from": data.ordered_from,
        **({ROWS: rows_digest(data)} if data.run is None else {}),
        "results": [
            {
                "learner": one.learner,
                "seed": one.seed,
                **shape,
                **{name: one.match.get(name) for name in MATCH},
                "footprint_return": one.footprint_return,
                "metrics": one.metrics,
                "notices": [message for _, message in one.notices],
            }
            for one, shape in zip(weighed, shapes, strict=True)
        ],
        "medians": {name: medians(of) for name, of in by_learner.items()},
        "made": {**made_by(command), "hours": hours},
    }


def card(of_data: Card, weighed: Sequence[Weighed]) -> Card:
    """The card of the data, with the policy's return and what became of the weights."""
    returns = [one.footprint_return for one in weighed if one.footprint_return is not None]
    policy = of_data.policy
    if policy is not None and returns:
        policy = replace(policy, returned=float(np.mean(returns)))
    same = dict.fromkeys(
        LEARNERS[one.learner].label
        for one in weighed
        if not LEARNERS[one.learner].uniform and np.ptp(one.weights) <= SAME
    )
    others = of_data.others
    if same:
        notice = (
            f"the weights of {', '.join(same)} are all the same: nothing tells the policy's steps "
            "from the data's; more rows, a longer --footprint, or the notices above say why"
        )
        others = (*others, ("uniform", notice))
    return replace(of_data, policy=policy, others=others)


def rows_digest(data: OrderedData) -> str:
    """A digest of the rows of `data`, eight characters."""
    packed = data.transitions.packed().numpy()
    return hashlib.sha256(packed.tobytes()).hexdigest()[:8]


def write(
    out: Path, data: OrderedData, weighed: Sequence[Weighed], bins: int, report: dict[str, Any]
) -> None:
    """Make the folder `out` with all files. Raises UserError if it cannot be made."""
    # Imported here, so that listing runs does not load matplotlib.
    from tom.reports.figures import Panel, profile_figure, save

    learners = dict.fromkeys(one.learner for one in weighed)
    share = data.ordered_from / len(data)
    panels = [Panel(LEARNERS[n].label, n, profiles(weighed, n, bins), share) for n in learners]
    with _unfinished(out) as folder:
        write_weights(folder / WEIGHTS, weighed, data.policy_distance)
        write_csv(folder / PROFILE, profile_rows(weighed, bins))
        if data.run is None:
            rows, version = data.transitions.numpy(), data.policy_version.numpy()
            behaviour = None if data.behaviour is None else data.behaviour.numpy()
            collected = Collected(0, rows, version, behaviour=behaviour)
            segment = folder / layout.segment(0)
            segment.parent.mkdir()
            np.savez(segment, allow_pickle=False, **decode.transition_arrays(collected))
            # For readers of runs, and those who weigh these rows from here.
            said = {"schema": layout.SCHEMA, "env": data.env, "task": description(data.env)}
            said |= {"data": data.name}
            replace_json(folder / layout.CONFIG, said, sync=False)
            save_scene(data.env, folder)
        save(profile_figure({data.name: panels}), folder, FIGURE)
        replace_json(folder / REPORT, report, sync=False)


def profiles(weighed: Sequence[Weighed], learner: str, bins: int) -> NDArray[np.float64]:
    """The weight profiles of one learner's seeds, (S, bins)."""
    return np.stack([bin_means(o.weights, bins).numpy() for o in weighed if o.learner == learner])


def profile_rows(weighed: Sequence[Weighed], bins: int) -> Iterator[dict[str, Any]]:
    """One row for each learner, seed and bin (0 is the oldest) with the mean weight."""
    for one in weighed:
        for number, mean in enumerate(bin_means(one.weights, bins).tolist()):
            place = {"learner": one.learner, "seed": one.seed, "bin": number}
            yield place | {"mean_weight": f"{mean:.6g}"}


def write_weights(
    path: Path, weighed: Sequence[Weighed], policy_distance: NDArray[np.float32] | None = None
) -> None:
    """One float32 column for each learner and seed, one row per transition, oldest first.

    If a learner has terms, they are further columns (`LEARNER-sSEED-TERM`). The distances (N,) to
    the policy are the first column.
    """
    columns = {} if policy_distance is None else {DISTANCE: policy_distance}
    for one in weighed:
        name = f"{one.learner}-s{one.seed}"
        columns[name] = one.weights
        if one.log_ratio is not None:
            columns[name + LOG_RATIO] = one.log_ratio
        columns |= {f"{name}-{term}": values for term, values in one.terms.items()}
    write_table(path, pa.table(columns), **NUMBERS)


def called(factor: float) -> str:
    """The name of weights of that factor, used in place of a learner's name."""
    return "as it is" if factor == UNCHANGED else f"region x {factor:g}"


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
            **progression(one.weights, report["ordered_from"]),
        }
        for one in models
    ]
    with _unfinished(out) as folder:
        table = pa.table({**columns, REGION: region})
        write_table(folder / WEIGHTS, table)
        if ghosts:
            np.savez_compressed(folder / GHOSTS, allow_pickle=False, **dict(ghosts))
        replace_json(folder / REPORT, {**report, "results": results}, sync=False)
