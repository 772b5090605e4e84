"""The results of `tom weigh` and `tom brush` for a run's buffer."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from app import text
from app.data import datasets
from app.data.readers import RunInfo
from tom.data.sampling import bin_means
from tom.record.array_files import DAMAGE, read_table
from tom.record.files import read_json
from tom.reports import weighing_files
from tom.reports.weighing_files import REPORT, ROWS, WEIGHTS, is_brush, reports

BINS = 100


@dataclass(frozen=True)
class WeighingInfo:
    """One result of `tom weigh`."""

    path: str
    policy: str
    preset: str
    changed: Mapping[str, str]  # settings that are not the preset's: path to text
    rows: int  # number of transitions, those of the run before `end`
    ordered_from: int  # rows before it are random data
    step: int | None  # the env step of the buffer; None: all transitions
    written: int  # mtime_ns of the report
    brush: bool  # of `tom brush`: a learner's weights multiplied in a region, and no learner's own
    learners: frozenset[str]
    notices: tuple[str, ...] = ()  # what the learners noticed about their weights
    keeps_rows: bool = False  # its folder holds the weighed rows, and no run's `step` counts them

    @property
    def name(self) -> str:
        return Path(self.path).name

    @property
    def end(self) -> int:
        """The number of the transition after the last weighed one, of the run or of its rows."""
        return self.rows if self.step is None or self.keeps_rows else self.step

    @property
    def settings(self) -> str:
        """TOM's settings of the weighing, in words."""
        words = "the run's own settings" if self.preset == "own" else f"its preset {self.preset}"
        changes = ", ".join(f"{path} {value}" for path, value in self.changed.items())
        return f"{words}, but {changes}" if changes else words

    def missing(self, rows: int) -> str:
        """In words, what it leaves out of a buffer of `rows` transitions; empty if nothing."""
        if self.step is not None and not self.keeps_rows:
            return (
                f"It weighs the {self.rows:,} transitions that the buffer held at step "
                f"{self.step:,}, of {rows:,} that were collected."
            )
        if self.rows == rows:
            return ""
        return (
            f"It weighs the first {self.rows:,} of now {rows:,} transitions: the run has gone on "
            "since."
        )


def weighed(store: str) -> set[str]:
    """The ids of the runs whose buffers have been weighed by learners."""
    return {
        str(report["data"])
        for _, report in reports(Path(store))
        if ROWS not in report and not is_brush(report)
    }


def of_run(run: RunInfo, rows: int) -> list[WeighingInfo]:
    """Learners' weighings of the buffer of a run (or data set) of `rows` rows, newest first.

    A resumed run has more rows than were weighed: the weighed ones are the first. Weighings of
    other data are left out.
    """
    return [weighing for weighing in _of_run(run, rows) if not weighing.brush]


def brushes(run: RunInfo, rows: int) -> list[WeighingInfo]:
    """The results of `tom brush`, like `of_run`."""
    return [weighing for weighing in _of_run(run, rows) if weighing.brush]


def _of_run(run: RunInfo, rows: int) -> list[WeighingInfo]:
    if datasets.is_one(run):
        paths = datasets.weighings(run)
    else:
        paths = weighing_files.of_run(Path(run.path).parent, run.run_id)
    weighings = [_read(path, rows) for path in paths]
    return sorted((w for w in weighings if w is not None), key=lambda w: w.written, reverse=True)


def weights(weighing: WeighingInfo) -> dict[tuple[str, int], NDArray[np.float32]]:
    """The weights (N,) by learner and seed; empty if the file cannot be read."""
    try:
        table = read_table(Path(weighing.path) / WEIGHTS)
    except DAMAGE:
        return {}
    by_seed = {}
    for column in table.columns:
        learner, _, seed = str(column).rpartition("-s")
        if learner and (number := text.whole(seed)) is not None:
            by_seed[learner, number] = np.array(table[column], np.float32)
    return by_seed


def profiles(of: dict[tuple[str, int], NDArray[np.float32]]) -> dict[str, NDArray[np.float64]]:
    """The weight profiles of each learner's seeds: (S, BINS)."""
    learners = list(dict.fromkeys(learner for learner, _ in of))
    return {
        name: np.stack([bin_means(w, BINS).numpy() for (n, _), w in of.items() if n == name])
        for name in learners
    }


def medians(weighing: WeighingInfo) -> dict[str, dict[str, float]]:
    """By learner the medians over seeds that `tom weigh` reported; empty if they cannot be read."""
    try:
        return {
            str(learner): {str(name): _number(value) for name, value in of.items()}
            for learner, of in read_json(Path(weighing.path) / REPORT)["medians"].items()
        }
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return {}


def _number(value: float | None) -> float:
    return np.nan if value is None else float(value)


def footprints(weighing: WeighingInfo) -> dict[str, NDArray[np.float64]]:
    """By learner the footprint of its weights and its standard error, for each seed (S, 2).

    At 1 the weighted buffer is as far from fresh episodes of the policy as the unweighted one.
    Empty if none was measured.
    """
    by_learner: dict[str, list[tuple[float, float]]] = {}
    try:
        for result in read_json(Path(weighing.path) / REPORT)["results"]:
            if result.get("footprint") is not None:
                measured = float(result["footprint"]), _number(result.get("footprint_se"))
                by_learner.setdefault(str(result["learner"]), []).append(measured)
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return {}
    return {learner: np.array(measured) for learner, measured in by_learner.items()}


def _read(path: Path, rows: int) -> WeighingInfo | None:
    try:
        report: dict[str, Any] = read_json(path / REPORT)
        written = (path / REPORT).stat().st_mtime_ns
        first, weighed = int(report["ordered_from"]), int(report["rows"])
        if not 0 <= first < weighed <= rows:
            return None
        policy, preset = str(report["policy"]), str(report["preset"])
        changed = {str(path): str(value) for path, value in report.get("changed", {}).items()}
        step = None if report.get("step") is None else int(report["step"])
        learners = frozenset(str(one["learner"]) for one in report.get("results", ()))
        notices = tuple(weighing_files.notices(report))
        return WeighingInfo(
            str(path), policy, preset, changed, weighed, first, step, written, is_brush(report),
            learners, notices, keeps_rows=ROWS in report,
        )  # fmt: skip
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return None
