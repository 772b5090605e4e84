"""Brushed regions of a run's buffer, the results of `tom brush`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from app.data import readers
from app.data.buffer import Rows
from app.data.readers import RunInfo
from app.data.weighings import WeighingInfo
from app.data.why import candidates
from tom.data.unpack import DAMAGE, read_arrays
from tom.record.decode import read_table
from tom.record.files import read_json
from tom.reports.weighing_files import BRUSH, GHOSTS, REGION, REPORT, WEIGHTS


@dataclass(frozen=True)
class Brushed:
    """The errors of models by region, factor and seed; factor 1 means the original weights."""

    name: str
    rows: int  # in the region
    of: int
    step: int
    model: dict[str, Any]
    errors: dict[str, dict[float, list[float]]]
    ghosts: dict[str, NDArray]  # joint positions (H + 1, nq): real, x1, x0, ...; and dt

    @property
    def factors(self) -> list[float]:
        """All factors except 1."""
        return sorted({f for of in self.errors.values() for f in of} - {1.0})


def of_run(brushes: list[WeighingInfo]) -> list[Brushed]:
    """The brushed regions of a run whose files can be read, newest first."""
    return [region for region in map(_read, brushes) if region is not None]


def base(run: RunInfo, rows: Rows, weighings: list[WeighingInfo]) -> str | None:
    """The option of `tom brush` for these weights: empty for the run's own.

    None if no file has them.
    """
    for table, column, (_, made) in candidates(readers.reader(run), weighings):
        if len(table[column]) == len(rows) and np.array_equal(table[column], rows.weight):
            return "" if made is None else f"{made.path}:{column}"
    return None


def _read(weighing: WeighingInfo) -> Brushed | None:
    path = Path(weighing.path)
    try:
        report = read_json(path / REPORT)
        about, results = report[BRUSH], report["results"]
        region = read_table(path / WEIGHTS)[REGION].to_numpy()
        errors: dict[str, dict[float, list[float]]] = {}
        for result in results:
            for name, error in result["errors"].items():
                value = float("nan") if error is None else float(error)
                errors.setdefault(name, {}).setdefault(float(result["factor"]), []).append(value)
        step = int(report["step"])
        model = {name: int(about["model"][name]) for name in ("layers", "hidden")}
    except (AttributeError, *DAMAGE):
        return None
    try:
        ghosts = read_arrays(path / GHOSTS)
    except DAMAGE:
        ghosts = {}
    count = int(region.sum())
    return Brushed(weighing.name, count, len(region), step, model, errors, dict(ghosts))
