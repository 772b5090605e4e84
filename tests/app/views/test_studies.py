"""Studies: the page shows what `tom reproduce` wrote, and nothing that it did not."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from PIL import Image
from starlette.requests import Request
from starlette.responses import FileResponse, Response
from studio_pages import draw

from app.data import studies
from app.links import Links
from app.servers.pages import routes
from tom.reports.files import write_csv
from tom.reports.html import Report, write_report

pytestmark = pytest.mark.usefixtures("studio")
ROWS = [{"learner": "tom", "error": 0.25}, {"learner": "mle", "error": 0.5}]


@pytest.fixture
def reports(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The studio was started in a folder with two studies."""
    monkeypatch.chdir(tmp_path)
    for name in ("road", "focus"):
        folder = tmp_path / "reports" / name
        folder.mkdir(parents=True)
        Image.fromarray(np.zeros((4, 4, 3), np.uint8)).save(folder / "errors.png")
        write_csv(folder / "errors.csv", ROWS * 300)
        write_csv(folder / "few.csv", ROWS[:1])
        write_csv(folder / "summary.csv", ROWS)
    road = tmp_path / "reports" / "road"
    write_report(Report("Road", "a claim", ["found"], [("figure", road / "errors.png")]), road)
    return tmp_path / "reports"


def test_studies_are_listed_with_their_files(reports: Path) -> None:
    (reports / "empty").mkdir()
    (reports / "focus" / "outside.png").symlink_to(reports / "road" / "errors.png")
    road, focus = studies.found()
    assert (road.name, focus.name) == ("road", "focus")
    assert [path.name for path in focus.tables] == ["summary.csv", "few.csv", "errors.csv"]
    assert [path.name for path in focus.figures] == ["errors.png"]
    assert focus.report is None
    assert studies.report("road") == Path("reports/road/report.html")
    assert studies.report("focus") is None
    assert studies.report("../reports/road") is None


def test_the_page_shows_a_studys_figures_and_numbers(reports: Path) -> None:
    app = draw("studies", study="focus")
    summary, _, errors = (frame.value for frame in app.dataframe)
    pd.testing.assert_frame_equal(summary, pd.DataFrame(ROWS))
    assert len(errors) == 200
    assert "200 of 600 lines" in app.expander[0].label  # single values are folded away
    assert [frame.value.equals(errors) for frame in app.expander[0].dataframe] == [True]
    assert len(app.image) == 1
    assert [code.value for code in app.code] == [
        f"tom reproduce {name}" for name in ("progression", "online", "returns", "tabular")
    ]


def test_a_level_that_was_never_reached_is_a_dash(reports: Path) -> None:
    write_csv(reports / "focus" / "summary.csv", [{"steps": np.inf}, {"steps": 5.0}])
    shown = draw("studies", study="focus").dataframe[0].value["steps"]
    assert (np.isnan(shown[0]), shown[1]) == (True, 5)


def test_a_damaged_table_is_named(reports: Path) -> None:
    (reports / "focus" / "summary.csv").write_bytes(b'"\xff')
    app = draw("studies", study="focus")
    assert "summary.csv" in app.warning[0].value.replace("\\", "")
    assert len(app.dataframe) == 2


@pytest.mark.parametrize("content", [b"", b"\x89PNG\r\n\x1a\n and no more"])
def test_a_damaged_figure_is_named(reports: Path, content: bytes) -> None:
    (reports / "focus" / "broken.png").write_bytes(content)
    app = draw("studies", study="focus")
    assert "broken.png" in app.warning[0].value.replace("\\", "")
    assert len(app.image) == 1


def test_without_a_study_the_page_says_how_to_make_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    app = draw("studies")
    assert len(app.code) == len(studies.QUESTIONS)
    assert str(tmp_path) in app.info[0].value


@pytest.mark.usefixtures("reports")
def test_a_report_runs_no_script() -> None:
    [route] = [route for route in routes(Links()) if route.path == "/reports/{study}"]

    def ask(study: str) -> Response:
        asked = {"path_params": {"study": study}, "headers": [(b"host", b"localhost:8600")]}
        answer = route.endpoint(Request({"type": "http", **asked}))
        assert isinstance(answer, Response)
        return answer

    found = ask("road")
    assert isinstance(found, FileResponse)
    assert "a claim" in Path(found.path).read_text()
    assert found.headers["content-security-policy"].startswith("sandbox;")
    assert ask("focus").status_code == 404
