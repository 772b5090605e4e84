"""The results of `tom weigh` and `tom brush`: of runs' buffers, and of data sets beside them."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from app import text
from app.data import buffer, readers
from app.data.cache import get_or_make
from tom.analysis.exams import at_fit
from tom.analysis.progression import medians, progression
from tom.data.sampling import bin_means
from tom.data.unpack import DAMAGE, read_arrays
from tom.envs import is_code
from tom.record.decode import read_table
from tom.record.files import modified
from tom.record.reader import RunReader
from tom.record.status import Labels, Status
from tom.reports import weighing_files
from tom.reports.weighing_files import (
    BRUSH,
    DISTANCE,
    GHOSTS,
    REGION,
    REPORT,
    ROWS,
    WEIGHTS,
    reports,
)

BINS = 100


class Dataset(RunReader):
    """A data set as the pages see a run: its rows are stored with its newest weighing."""

    def __init__(self, path: Path, report: Mapping[str, Any]) -> None:
        super().__init__(path)
        self.report = report
        self.config = self.config | {"learner": "data", "preset": ""}  # nothing was trained
        self.labels = Labels(name=self.run_id)  # it has no learner and no seed to distinguish it
        self.status = Status()

    @property
    def run_id(self) -> str:
        return _dataset_id(self.report)

    @property
    def command(self) -> str:
        """The command of its last weighing."""
        return str(self.report.get("made", {}).get("command", ""))

    def weigh_arguments(self, store: str) -> list[str]:
        """The arguments of `tom` that weigh it again, from the rows of its last weighing."""
        results, policy = self.report["results"], self.report["policy"]
        learners, seeds = (
            list(dict.fromkeys(str(result[name]) for result in results))
            for name in ("learner", "seed")
        )
        more = ["--env", self.env] if is_code(self.env) else []
        for path, value in self.report.get("changed", {}).items():
            more += [f"--{path.replace('_', '-')}", value]
        return [
            "weigh", str(self.path), "--policy", policy, *more, "--learner", *learners,
            "--seeds", *seeds, "--preset", str(self.report.get("preset", "exact")),
            "--footprint", str(self.report.get("footprint", 1000)), "--store", store,
        ]  # fmt: skip


def datasets(store: str) -> tuple[Dataset, ...]:
    """The weighed data sets of a store, newest first; each once, from its newest weighing."""
    kept = [(path, report) for path, report in reports(Path(store)) if ROWS in report]
    kept.sort(key=lambda one: modified(one[0] / REPORT))
    newest = {_dataset_id(report): Dataset(path, report) for path, report in kept}
    return tuple(reversed(newest.values()))


def _dataset_id(report: Mapping[str, Any]) -> str:
    return f"{report['data']}-{report[ROWS]}"


@dataclass(frozen=True)
class Weighing:
    """One result of `tom weigh` or `tom brush`: a folder and its report.

    Live weights of a loop's buffer at one fit are like one; their `columns` are in no file there.
    """

    path: Path
    report: Mapping[str, Any]
    columns: Mapping[str, NDArray] | None = None

    @property
    def name(self) -> str:
        return self.path.name

    @property
    def rows(self) -> int:
        """The number of weighed transitions, those of the run before `end`."""
        return self.report["rows"]

    @property
    def ordered_from(self) -> int:
        """The number of rows of random data, which come first."""
        return self.report.get("ordered_from", self.rows)

    @property
    def step(self) -> int | None:
        """The env step of the buffer; None: all transitions."""
        return self.report.get("step")

    @property
    def written(self) -> int:
        """The report's modification time in ns."""
        return modified(self.path / REPORT)

    @property
    def end(self) -> int:
        """The number of the transition after the last weighed one, of the run or of its rows."""
        return self.report["end"]

    @property
    def policy(self) -> str:
        """Whose policy it weighs for, in words."""
        name = self.report["policy"]
        return "its own policy" if name == self.report["data"] else f"the policy of {name}"

    @property
    def settings(self) -> str:
        """TOM's settings of the weighing, in words."""
        preset = self.report["preset"]
        words = "the run's own settings" if preset == "own" else f"its preset {preset}"
        changed = self.report.get("changed", {})
        changes = ", ".join(f"{path} {value}" for path, value in changed.items())
        return f"{words}, but {changes}" if changes else words

    def missing(self, rows: int) -> str:
        """In words, what it leaves out of a buffer of `rows` transitions; empty if nothing."""
        if self.rows == rows:
            return ""
        if self.step is not None:
            return (
                f"It weighs the {self.rows:,} transitions that the buffer held at step "
                f"{self.step:,}, of {rows:,} collected in all."
            )
        return (
            f"It weighs the first {self.rows:,} of now {rows:,} transitions; the run has gone on "
            "since."
        )

    def table(self) -> Mapping[str, NDArray]:
        """The columns (N,) of its weights and their terms; empty if they cannot be read."""

        def read() -> dict[str, NDArray]:
            try:
                table = read_table(self.path / WEIGHTS)
            except DAMAGE:
                return {}
            return {str(name): np.array(table[name]) for name in table}

        if self.columns is not None:
            return self.columns
        return get_or_make(("weights", self.path), modified(self.path / WEIGHTS), read)

    def weights(self) -> dict[tuple[str, int], NDArray[np.float32]]:
        """The weights (N,) by learner and seed; empty if they cannot be read."""
        parts = {column: column.rpartition("-s") for column in self.table()}
        return {
            (learner, seed): self.table()[column].astype(np.float32, copy=False)
            for column, (learner, _, words) in parts.items()
            if learner and (seed := text.parse_int(words)) is not None
        }

    @property
    def policy_distance(self) -> NDArray[np.float64] | None:
        """The distance (N,) of each row's action to the policy; None in older weighings."""
        found = self.table().get(DISTANCE)
        return None if found is None else found.astype(np.float64)

    @property
    def footprints(self) -> dict[str, NDArray[np.float64]]:
        """By learner the footprint and its standard error for each seed, (S, 2).

        At 1 the weighted buffer is as far from fresh episodes of the policy as the unweighted one.
        Empty if none was measured.
        """
        measured: dict[str, list[tuple[float, float | None]]] = {}
        for result in self.report["results"]:
            if (footprint := result.get("footprint")) is not None:
                pair = footprint, result.get("footprint_se")
                measured.setdefault(result["learner"], []).append(pair)
        return {learner: np.array(pairs, np.float64) for learner, pairs in measured.items()}


def profiles(weights: Mapping[tuple[str, int], NDArray]) -> dict[str, NDArray[np.float64]]:
    """The weight profiles of each learner's seeds: (S, BINS)."""
    learners = dict.fromkeys(learner for learner, _ in weights)
    return {
        name: np.stack([bin_means(w, BINS).numpy() for (n, _), w in weights.items() if n == name])
        for name in learners
    }


def weighed_run_ids(store: str) -> set[str]:
    """The ids of the runs whose buffers have been weighed by learners."""
    found = (report for _, report in reports(Path(store)) if ROWS not in report)
    return {report["data"] for report in found if not weighing_files.is_brush(report)}


def of_run(run: RunReader, *, brush: bool = False) -> list[Weighing]:
    """Learners' weighings of the buffer of a run (or data set), newest first.

    Or brushes of it. A resumed run has more rows than were weighed: the weighed ones are the first.
    Weighings of other data are left out.
    """
    of_data = isinstance(run, Dataset)
    store = run.path.parents[1] if of_data else run.home.parent
    found = [
        Weighing(path, report)
        for path, report in reports(store)
        if (ROWS in report) == of_data
        and run.run_id == (_dataset_id(report) if of_data else report["data"])
        and weighing_files.is_brush(report) == brush
    ]
    length = buffer.length(run)
    kept = [one for one in found if 0 <= one.ordered_from < one.rows <= length]
    return sorted(kept, key=lambda one: one.written, reverse=True)


def all_of_run(run: RunReader) -> list[Weighing]:
    """Those of `of_run`; in front of them the live weights of a loop's buffer, if it has any."""
    return [*(live_weights(run) if run.own_loop else ()), *of_run(run)]


def titles(found: Sequence[Weighing]) -> dict[str, str]:
    """`step 30,000, by its own policy` for each name; with the name where several are alike."""
    words = {
        one.name: f"{'all rows' if one.step is None else f'step {one.step:,}'}, by {one.policy}"
        for one in found
    }
    shared = Counter(words.values())
    return {name: of if shared[of] == 1 else f"{of}: {name}" for name, of in words.items()}


def live_weights(run: RunReader) -> list[Weighing]:
    """Those of the last fit that all learners keep: of one with exams, if there is any."""
    found = run.live()
    kept = [set(live.snapshot_steps()) for live in found.values()]
    exams = {
        step: {name: at_fit(readers.metrics(live), step) for name, live in found.items()}
        for step in (set.intersection(*kept) if kept else ())
    }
    if not exams:
        return []
    step = max(exams, key=lambda step: (all(exams[step].values()), step))
    weights = {
        name: live.snapshot(step)["weight"].to_numpy(copy=True) for name, live in found.items()
    }
    rows = max(map(len, weights.values()))
    results = [
        {"learner": name, "seed": run.seed}
        | {part: of.get(f"exam/{part}") for part in ("footprint", "footprint_se")}
        for name, of in exams[step].items()
    ]
    report = {
        "data": run.run_id, "policy": run.run_id, "step": step, "results": results,
        "rows": rows, "end": rows, "ordered_from": 0, "preset": "of tom train",
        "medians": {name: medians([progression(of, 0)]) for name, of in weights.items()},
    }  # fmt: skip
    columns = {f"{name}-s{run.seed}": of for name, of in weights.items()}
    return [Weighing(run.path / "live", report, columns)]


@dataclass(frozen=True)
class Brushed:
    """The errors of models by region, factor and seed; factor 1 means the original weights."""

    name: str
    rows: int  # in the region
    buffer_rows: int
    step: int
    model: dict[str, Any]
    errors: dict[str, dict[float, list[float]]]
    ghosts: dict[str, NDArray]  # joint positions (H + 1, nq): real, x1, x0, ...; and dt

    @property
    def factors(self) -> list[float]:
        """All factors except 1."""
        return sorted({f for of in self.errors.values() for f in of} - {1.0})

    def change(self, region: str, factor: float) -> NDArray[np.float64]:
        """The model's error (S,) for each seed, relative to the original weights; maybe empty."""
        of = self.errors.get(region, {})
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.array(of.get(factor, [])) / np.array(of.get(1.0, []))


def brushed(brush: Weighing) -> Brushed | None:
    """A brushed region; None if its files cannot be read."""
    errors: dict[str, dict[float, list[float]]] = {}
    try:
        region = read_table(brush.path / WEIGHTS)[REGION].to_numpy()
        for result in brush.report["results"]:
            for name, error in result["errors"].items():
                of_seeds = errors.setdefault(name, {}).setdefault(float(result["factor"]), [])
                of_seeds.append(np.nan if error is None else float(error))
        model = {name: int(brush.report[BRUSH]["model"][name]) for name in ("layers", "hidden")}
        step = int(brush.report["step"])
    except (AttributeError, *DAMAGE):
        return None
    try:
        ghosts = dict(read_arrays(brush.path / GHOSTS))
    except DAMAGE:
        ghosts = {}
    return Brushed(brush.name, int(region.sum()), len(region), step, model, errors, ghosts)
