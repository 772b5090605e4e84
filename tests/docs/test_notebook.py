"""docs/notebook.ipynb runs from top to bottom and displays frames and figures."""

import asyncio
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

pytestmark = pytest.mark.slow
ROOT = Path(__file__).parents[2]
PATH = ROOT / "docs/notebook.ipynb"
FIGURE = "application/vnd.plotly.v1+json"


@pytest.fixture(scope="module")
def outputs() -> dict[str, list[dict]]:
    """What each cell of code displayed: the data of its outputs by kind, by the cell's source."""
    notebook = nbformat.read(PATH, as_version=4)
    client = NotebookClient(notebook, timeout=300, resources={"metadata": {"path": str(ROOT)}})
    asyncio.run(client.async_execute())
    cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
    return {
        cell.source: [output["data"] for output in cell.outputs if "data" in output]
        for cell in cells
    }


def shown(outputs: dict[str, list[dict]], source: str) -> list[dict]:
    return next(found for text, found in outputs.items() if source in text)


def test_runs_weighings_and_frames_are_tables(outputs):
    for source in ("tom.load(", "run.metrics", "run.profiles", "run.transitions", "tom.weigh("):
        (table,) = shown(outputs, source)
        assert "<table" in table["text/html"]
    assert "inverted-pendulum" in shown(outputs, "tom.load(")[0]["text/html"]


def test_figures_are_plotlys_each_under_its_name(outputs):
    of_run = shown(outputs, "tom.studio.show(run)")
    titles = [data["text/markdown"] for data in of_run if "text/markdown" in data]
    assert titles == ["**return**", "**every fit**", "**the last fit**"]
    assert sum(FIGURE in data for data in of_run) == len(titles)
    (profiles,) = shown(outputs, "tom.studio.show(weighing)")
    names = {line.get("name") for line in profiles[FIGURE]["data"]}
    assert {"TOM (1 seed)", "PMAC (1 seed)", "MLE (1 seed)"} <= names


def test_the_notebook_lies_here_without_outputs():
    cells = nbformat.read(PATH, as_version=4).cells
    assert not any(cell.get("outputs") or cell.get("execution_count") for cell in cells)
