"""What `tom weigh` left behind for a run's buffer: several learners' weights of the same rows."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from app.data.readers import RunInfo
from tom.analysis.progression import Progression, progression
from tom.data.sampling import bin_means
from tom.record.array_files import DAMAGE, read_table
from tom.record.files import read_json
from tom.reports import weighing_files
from tom.reports.weighing_files import REPORT, WEIGHTS

BINS = 100


@dataclass(frozen=True)
class Weighing:
    """One result of `tom weigh`."""

    path: str
    policy: str
    preset: str
    rows: int  # so many transitions of the run, those before `end`
    ordered_from: int  # rows before it are random data
    step: int | None  # the env step at which the buffer held them; None: all there were
    written: int  # of the report, mtime_ns

    @property
    def name(self) -> str:
        return Path(self.path).name

    @property
    def end(self) -> int:
        """The number of the run's transition that follows the last one weighed."""
        return self.rows if self.step is None else self.step

    @property
    def settings(self) -> str:
        """Those that TOM weighed with, in words."""
        return "the run's own settings" if self.preset == "own" else f"its preset {self.preset}"

    def missing(self, rows: int) -> str:
        """In words, what it leaves out of a buffer of `rows` transitions; empty where nothing."""
        if self.step is not None:
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


def of_run(run: RunInfo, rows: int) -> list[Weighing]:
    """The weighings in a run's store of its buffer of `rows` transitions, newest first.

    A run that went on has more rows than were weighed: these are its first. What is no weighing,
    or of other data, is left out.
    """
    store = Path(run.path).parent
    found = [_read(path, rows) for path in weighing_files.of_run(store, run.run_id)]
    return sorted((w for w in found if w is not None), key=lambda w: w.written, reverse=True)


def weights(weighing: Weighing) -> dict[tuple[str, int], NDArray[np.float32]]:
    """The weights (N,) by learner and seed; empty when the file cannot be read."""
    try:
        table = read_table(Path(weighing.path) / WEIGHTS)
    except DAMAGE:
        return {}
    found = {}
    for column in table.columns:
        learner, _, seed = str(column).rpartition("-s")
        if learner and seed.isdigit():
            found[learner, int(seed)] = np.array(table[column], np.float32)
    return found


def profiles(of: dict[tuple[str, int], NDArray[np.float32]]) -> dict[str, NDArray[np.float64]]:
    """The weight profiles of each learner's seeds: (S, BINS)."""
    learners = list(dict.fromkeys(learner for learner, _ in of))
    return {
        name: np.stack([bin_means(w, BINS).numpy() for (n, _), w in of.items() if n == name])
        for name in learners
    }


def numbers(
    weighing: Weighing, of: dict[tuple[str, int], NDArray[np.float32]]
) -> dict[str, list[Progression]]:
    """What each learner's weights come to, a summary for each seed."""
    found: dict[str, list[Progression]] = {}
    for (learner, _), weight in of.items():
        found.setdefault(learner, []).append(progression(weight, weighing.ordered_from))
    return found


def _read(path: Path, rows: int) -> Weighing | None:
    try:
        report: dict[str, Any] = read_json(path / REPORT)
        written = (path / REPORT).stat().st_mtime_ns
        first, weighed = int(report["ordered_from"]), int(report["rows"])
        if not 0 <= first < weighed <= rows:
            return None
        policy, preset = str(report["policy"]), str(report["preset"])
        step = None if report.get("step") is None else int(report["step"])
        return Weighing(str(path), policy, preset, weighed, first, step, written)
    except (OSError, ValueError, KeyError, TypeError):
        return None
