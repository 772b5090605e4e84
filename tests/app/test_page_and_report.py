"""Curves and `tom reproduce returns` say the same of the gallery's runs."""

import shutil
from pathlib import Path

import pytest
from studio_pages import Show, draw

from tom.learners import LEARNERS
from tom.record import Store
from tom.studies import returns_cells as study
from tom.studies import returns_tables as tables

RUNS = Path(__file__).parents[2] / "runs"
COPIES = [run for run in Store(RUNS).runs() if run.small_copy and run.fits_model]
GALLERY = study.select(COPIES, "paper")[0]
ENVS = list(dict.fromkeys(cell.env for cell in GALLERY))


LABELS = [entry.label for entry in LEARNERS.values()]
"""groups' titles; the page shows six groups until others are opened"""
LARGE = ("buffer", "checkpoint", "episodes", "model", "policies", "weights", "*.rrd")


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The runs that the report takes, alone, without what no return is read from."""
    path = tmp_path_factory.mktemp("gallery")
    for run in (run for cell in GALLERY for run in cell.runs):
        shutil.copytree(run.path, path / run.run_id, ignore=shutil.ignore_patterns(*LARGE))
    return path


@pytest.fixture(autouse=True)
def shown(store: Path, show: Show) -> None:
    show(store)


def reported(env: str, at: int | None = None) -> dict[str, dict]:
    cells = study.select(COPIES, "paper", at={env: at})[0] if at else GALLERY
    return {row["learner"]: row for row in tables.summary(cells) if row["env"] == env}


@pytest.mark.parametrize("env", ENVS[:2])
def test_the_table_of_curves_is_the_report_s(env: str) -> None:
    table = (
        draw("curves", task=env, panel="eval/return", show=LABELS)
        .dataframe[0]
        .value.set_index("learner")
    )
    rows = reported(env)
    assert set(table.index) == set(rows)
    for learner in rows:
        on_page = table.loc[learner]  # each row is up to the step that its own runs reach
        row = reported(env, int(on_page["steps"]))[learner]
        assert (on_page["n"], on_page["steps"]) == (row["n"], row["at step"])
        assert on_page["best"] == row["mean"]
        assert on_page["best, 95 %"] == f"{row['low']:,.4g} to {row['high']:,.4g}"
