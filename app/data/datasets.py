"""Data sets that `tom weigh` was given: their rows are stored with their weighings."""

from pathlib import Path
from typing import Any

from app.data.readers import RunInfo
from tom.envs import is_code
from tom.errors import UserError
from tom.record.files import modified
from tom.record.labels import Labels
from tom.record.status import Status
from tom.reports.weighing_files import REPORT, ROWS, reports

KIND = "data"
"""stands for the learner: nothing was trained"""


def listing(store: str) -> tuple[RunInfo, ...]:
    """The weighed data sets of a store, as `RunInfo`, newest first.

    A data set that was weighed several times appears once, from its newest weighing.
    """
    datasets = sorted(_kept(Path(store)), key=lambda one: modified(one[0] / REPORT))
    newest = {_called(report): _info(path, report) for path, report in datasets}
    return tuple(reversed(newest.values()))


def is_one(run: RunInfo) -> bool:
    """Whether it is a data set instead of a run."""
    return run.learner == KIND


def weighings(run: RunInfo) -> list[Path]:
    """The weighings of the data set `run`, by name."""
    datasets = _kept(Path(run.path).parents[1])
    return [path for path, report in datasets if _called(report) == run.run_id]


def command(run: RunInfo) -> str:
    """The command of its last weighing."""
    report = dict(reports(Path(run.path).parents[1])).get(Path(run.path), {})
    made = report.get("made")
    return str(made.get("command", "")) if isinstance(made, dict) else ""


def words(run: RunInfo, store: str) -> list[str]:
    """The arguments of `tom` that weigh the data set again, from the rows of its last weighing."""
    report = dict(reports(Path(run.path).parents[1])).get(Path(run.path), {})
    code = ["--env", run.env] if is_code(run.env) else []
    return [
        "weigh", run.path, "--policy", str(report.get("policy", "POLICY")), *code,
        "--learner", *_each(report, "learner"), "--seeds", *_each(report, "seed"),
        "--preset", str(report.get("preset", "exact")), "--store", store,
    ]  # fmt: skip


def find(store: str, name: str) -> RunInfo:
    """The data set `name`. Raises UserError if there is none."""
    for one in listing(store):
        if one.run_id == name:
            return one
    raise UserError(f"no data set '{name}' was weighed in {store}/")


def _kept(store: Path) -> list[tuple[Path, dict[str, Any]]]:
    return [(path, report) for path, report in reports(store) if ROWS in report]


def _each(report: dict[str, Any], name: str) -> list[str]:
    """The distinct values of `name` in the results of a report."""
    rows = [row for row in report.get("results", []) if isinstance(row, dict)]
    return list(dict.fromkeys(str(row.get(name)) for row in rows))


def _called(report: dict[str, Any]) -> str:
    return f"{report['data']}-{report[ROWS]}"


def _info(path: Path, report: dict[str, Any]) -> RunInfo:
    return RunInfo(
        path=str(path),
        run_id=_called(report),
        env=str(report.get("env", "?")),
        learner=KIND,
        seed=0,
        preset="",
        created="",
        status=Status(),
        problems=(),
        labels=Labels(name=_called(report)),  # it has no learner and no seed to distinguish it
        settings={},
        small_copy=False,
        left_out=(),
    )
