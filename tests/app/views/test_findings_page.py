"""Findings: the page shows what `tom reproduce` wrote, and nothing that it did not."""

import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from common import change, present
from PIL import Image
from starlette.requests import Request
from starlette.responses import FileResponse, Response
from starlette.routing import Route
from studio_pages import Show, draw, figures
from studio_runs import PENDULUM_TOM

from app.data import readers, studies
from app.data.verdicts import on_two_axes
from app.links import Links
from app.parts import jobs
from app.servers.pages import routes
from tom.record import layout
from tom.reports.report import write_csv, write_report
from tom.studies import STUDIES, load

pytestmark = pytest.mark.usefixtures("studio")
GALLERY = Path(__file__).parents[3] / "runs" / "studies"
ROWS = [{"learner": "tom", "error": 0.25}, {"learner": "mle", "error": 0.5}]


@pytest.fixture
def reports(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The studio was started in a folder with two studies."""
    monkeypatch.chdir(tmp_path)
    for name in ("road", "progression"):
        folder = tmp_path / "reports" / name
        folder.mkdir(parents=True)
        Image.fromarray(np.zeros((4, 4, 3), np.uint8)).save(folder / "errors.png")
        write_csv(folder / "errors.csv", ROWS * 300)
        write_csv(folder / "few.csv", ROWS[:1])
        write_csv(folder / "summary.csv", ROWS)
    road = tmp_path / "reports" / "road"
    write_report(road, "Road", "a claim", ["found"], [("figure", road / "errors.png")])
    return tmp_path / "reports"


def test_studies_are_listed_with_their_files(reports: Path) -> None:
    (reports / "empty").mkdir()
    (reports / "progression" / "outside.png").symlink_to(reports / "road" / "errors.png")
    road, other = studies.listing(studies.FOLDER)
    assert (road.name, other.name) == ("road", "progression")
    assert [path.name for path in other.tables] == ["summary.csv", "few.csv", "errors.csv"]
    assert [path.name for path in other.figures] == ["errors.png"]
    assert other.report is None
    assert studies.report("road", studies.FOLDER) == Path("reports/road/report.html")
    assert studies.report("progression", studies.FOLDER) is None
    assert studies.report("../reports/road", studies.FOLDER) is None


def test_the_page_shows_a_studys_figures_and_numbers(reports: Path, store: Path) -> None:
    app = draw("findings", study="progression")
    summary, _, errors = (frame.value for frame in app.dataframe)
    pd.testing.assert_frame_equal(summary, pd.DataFrame(ROWS))
    assert len(errors) == 600
    assert "600 lines" in app.expander[0].label  # single values are folded away
    assert [frame.value.equals(errors) for frame in app.expander[0].dataframe] == [True]
    [image] = app.image
    assert image.proto.imgs[0].alt == f"errors: {load('progression').QUESTION}"
    offered = [code.value.split() for code in app.code]
    assert {words[2] for words in offered} < {*STUDIES}
    assert all(words[3:] in ([], ["--store", str(store)]) for words in offered)


def test_a_card_says_its_question_and_finding_and_opens_the_study(reports: Path) -> None:
    app = draw("findings")
    asked = {load(name).QUESTION for name in ("road", "progression")}
    assert {card.value for card in app.header} == asked
    assert "**found**" in [words.value for words in app.markdown]
    assert len(app.image) == 2
    app.button(key="open progression").click().run()
    assert app.query_params["study"] == "progression"
    assert app.header[0].value == load("progression").QUESTION


def test_all_ways_are_drawn_once_both_studies_are_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    shutil.copytree(GALLERY / "footprint", tmp_path / "reports" / "footprint")
    assert len(draw("findings").header) == 1
    shutil.copytree(GALLERY / "capacity", tmp_path / "reports" / "capacity")
    app = draw("findings")
    assert len(app.header) == 3
    found = present(on_two_axes(studies.listing(studies.FOLDER)).get("capacity"))
    ways = [one for panel in found.panels for one in panel.ways]
    drawn = figures(app)[0]["data"]
    assert [(*trace["x"], *trace["y"]) for trace in drawn] == [
        (distance.value, error.value) for _, distance, error in ways
    ]
    named = [trace["name"] for trace in drawn if trace["showlegend"]]
    assert sorted(named) == sorted({trace["name"] for trace in drawn})


def test_studies_of_one_question_share_a_card(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    for name in ("capacity", "capacity-ways"):
        shutil.copytree(GALLERY / name, tmp_path / "reports" / name)
    app = draw("findings")
    assert [card.value for card in app.header] == [load("capacity").QUESTION]
    app.selectbox(key="capacity").select("capacity-ways").run()
    assert "PMER" in app.header[0].value
    assert app.query_params["capacity"] == "capacity-ways"
    app.button(key="open capacity-ways").click().run()
    assert app.button_group(key="study").options[1:] == ["capacity", "capacity-ways"]
    app.button_group(key="study").set_value("Every question").run()
    assert "study" not in app.query_params


def test_a_study_says_the_claim_the_verdict_and_the_command(reports: Path) -> None:
    origin = {"command": "tom reproduce road --jobs 1", "n": "8 seeds"}
    found = ["It holds.", "But <b>"]
    write_report(reports / "road", "Road", "the *claim*", found, origin=origin)
    app = draw("findings", study="road")
    words = "\n".join(element.value for element in app.markdown)
    assert r"the \*claim\*" in words
    assert "- It holds" in words
    assert r"But \<b\>" in words
    assert app.code[0].value == "tom reproduce road --jobs 1"
    (reports / "road" / "report.json").write_text('{"claim": 1}')  # damaged: the rest is shown
    app = draw("findings", study="road")
    assert "claim" not in "\n".join(element.value for element in app.markdown)
    assert len(app.image) == 1


def test_studies_that_came_with_the_store_are_shown_and_ones_own_before_them(
    reports: Path, store: Path, tmp_path: Path, show: Show
) -> None:
    shipped = shutil.copytree(store, tmp_path / "store") / "studies"
    (reports / "tabular" / "cases").mkdir(parents=True)  # it is being computed again
    for name in ("road", "tabular"):
        (shipped / name).mkdir(parents=True)
        write_report(shipped / name, name, "shipped", ["found"])
    show(shipped.parent)
    found = {study.name: study for study in studies.listing(*studies.folders(shipped.parent))}
    assert list(found) == ["road", "progression", "tabular"]
    assert found["road"].claim == "a claim"
    assert found["tabular"].claim == "shipped"
    assert "shipped" in "\n".join(e.value for e in draw("findings", study="tabular").markdown)
    assert not readers.listing(str(shipped.parent)).problems  # and they are no broken runs


@pytest.mark.slow
def test_a_study_is_run_from_the_page_and_one_that_fails_says_why(
    own: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    app = draw("findings")
    for state in ("failed", "made"):
        if state == "made":
            change(own / PENDULUM_TOM / layout.CONFIG, preset="paper")
        app.button(key="run returns").click().run()
        assert app.button(key="run returns").disabled
        jobs.started_commands()["returns"].process.wait(120)
        app.run()
        assert bool(app.error) == (state == "failed")
    assert [study.name for study in studies.listing(studies.FOLDER)] == ["returns"]
    whole = draw("findings", study="returns")
    assert whole.code[0].value.startswith("tom reproduce returns --store")


def test_numbers_that_are_none_and_damaged_files_leave_the_rest(reports: Path) -> None:
    write_csv(reports / "progression" / "summary.csv", [{"steps": np.inf}, {"steps": 5.0}])
    (reports / "progression" / "few.csv").write_bytes(b'"\xff')
    (reports / "progression" / "torn.png").write_bytes(b"\x89PNG\r\n\x1a\n and no more")
    app = draw("findings", study="progression")
    shown = app.dataframe[0].value["steps"]
    assert (np.isnan(shown[0]), shown[1]) == (True, 5)
    said = "".join(warning.value.replace("\\", "") for warning in app.warning)
    assert all(name in said for name in ("few.csv", "torn.png"))
    assert (len(app.dataframe), len(app.image)) == (2, 1)


@pytest.mark.usefixtures("reports")
def test_a_report_runs_no_script() -> None:
    served = [route for route in routes(Links()) if isinstance(route, Route)]
    [route] = [route for route in served if route.path == "/reports/{study}"]

    def ask(study: str) -> Response:
        asked = {"path_params": {"study": study}, "headers": [(b"host", b"localhost:8600")]}
        answer = route.endpoint(Request({"type": "http", **asked}))
        assert isinstance(answer, Response)
        return answer

    found = ask("road")
    assert isinstance(found, FileResponse)
    assert "a claim" in Path(found.path).read_text()
    assert found.headers["content-security-policy"].startswith("sandbox;")
    assert ask("progression").status_code == 404
