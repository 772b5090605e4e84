"""The counterfactual brush: what the page shows is what `tom brush` measured."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from commands import code_of
from common import change
from studio_pages import Show, array, draw, figures, in_browser, in_buffer, saved
from studio_runs import PENDULUM_TOM, info, with_weighing

from app.data import buffer_map, weighings
from app.data.weighings import Brushed
from app.figures.why import brushed_errors
from app.views.attention.why import brush_arguments
from tom.analysis.brush import REGION, REST
from tom.cli import main
from tom.record.decode import read_table
from tom.record.reader import RunReader
from tom.reports.weighing_files import REPORT, WEIGHTS, copy_small

FIT = 300


@pytest.fixture(scope="module")
def made(store: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A real brush of the pendulum's newest rows."""
    folder = tmp_path_factory.mktemp("brush")
    rows = folder / "rows.txt"
    rows.write_text("\n".join(map(str, range(150, 300))))
    words = brush_arguments(PENDULUM_TOM, str(rows), FIT, "", (0, 4), str(store))
    words += ["--seeds", "0", "1", "--out", str(folder / "made")]
    assert main(words) == 0
    return folder / "made"


@pytest.fixture
def brushed(store: Path, made: Path, tmp_path: Path, show: Show) -> Path:
    """The studio shows a store with that brush."""
    there = with_weighing(store, made, tmp_path)
    show(there)
    return there


def test_a_brush_is_a_weighing_whose_region_is_multiplied(made: Path, store: Path) -> None:
    table = read_table(made / "weights.parquet")
    own = RunReader(store / PENDULUM_TOM).snapshot(FIT)["weight"].to_numpy()
    region = table["region"].to_numpy()
    assert region.tolist() == [False] * 150 + [True] * 150
    more = own * np.where(region, 4, 1)
    assert table["region x 4-s0"].to_numpy() == pytest.approx(more / more.mean(), abs=1e-5)
    assert (table["region x 0-s0"].to_numpy()[region] == 0).all()


def test_weights_of_other_rows_are_refused(made: Path, store: Path, tmp_path: Path, capsys) -> None:
    """A weighing of another run, or of another step, may have as many rows."""
    words = ["brush", PENDULUM_TOM, "--rows", str(made.parent / "rows.txt"), "--step", str(FIT)]
    words += ["--store", str(store), "--factors", "0", "--seeds", "0"]
    for number, other in enumerate(({"data": "another"}, {"end": FIT + 50}, {})):
        shutil.copytree(made, copy := tmp_path / str(number))
        change(copy / REPORT, **other)
        given = [*words, "--weighing", f"{copy}:as it is-s0", "--out", str(copy / "out")]
        assert code_of(given) == (2 if other else 0)
    assert len(capsys.readouterr().err.splitlines()) == 2 + 2  # one each, and two models


def test_the_page_shows_what_was_measured(brushed: Path) -> None:
    run = info(brushed, PENDULUM_TOM)
    (found,) = map(weighings.brushed, weighings.of_run(run, brush=True))
    assert found is not None
    report = json.loads((brushed / "weighings/made/report.json").read_text())
    of = {(r["factor"], r["seed"]): r["errors"] for r in report["results"]}
    ratio = np.mean([of[4, s]["rest"] / of[1, s]["rest"] for s in (0, 1)])
    app = in_buffer(run=PENDULUM_TOM, step=str(FIT))
    (points,) = [f for f in figures(app) if "weight x 4" in [of.get("name") for of in f["data"]]]
    assert array(points["data"][1]["x"])[1] == pytest.approx(ratio)
    assert found.factors == [0, 4]
    assert found.ghosts["real"].shape == found.ghosts["x4"].shape
    assert "region x 4 s0, made" in app.selectbox(key="weights").options


def test_a_brush_is_not_shown_as_several_learners_on_the_buffer(brushed: Path) -> None:
    run = info(brushed, PENDULUM_TOM)
    assert weighings.of_run(run) == []
    assert [one.name for one in weighings.of_run(run, brush=True)] == ["made"]
    assert weighings.weighed_run_ids(str(brushed)) == set()
    app = draw("attention", part="Every learner on one buffer", run=PENDULUM_TOM, weighed="made")
    assert not figures(app)


def test_a_weighing_is_not_taken_for_a_brush_of_it(brushed: Path) -> None:
    """A brush repeats the weights that it multiplies, maybe to the last bit, and is newer."""
    words = ["weigh", PENDULUM_TOM, "--policy", PENDULUM_TOM, "--step", str(FIT)]
    words += ["--learner", "tom", "--seeds", "0", "--footprint", "100", "--matmul", "default"]
    weighing = brushed / "weighings/tom"
    assert main([*words, "--out", str(weighing), "--store", str(brushed)]) == 0
    weight = read_table(weighing / WEIGHTS)["tom-s0"].to_numpy()
    brush_file, brush_report = (brushed / "weighings/made" / name for name in (WEIGHTS, REPORT))
    table = read_table(brush_file)
    brush_file.unlink()  # which is a link
    table.assign(**{"as it is-s0": weight}).to_parquet(brush_file)
    brush_report.touch()
    app = in_buffer(run=PENDULUM_TOM, weights="TOM s0, tom", row="5")
    assert any(figure["data"][0]["type"] == "waterfall" for figure in figures(app))
    source = buffer_map.sources(info(brushed, PENDULUM_TOM))["TOM s0, tom"]
    assert source.option == f"{weighing}:tom-s0"


def test_brushed_weights_have_no_sum(brushed: Path) -> None:
    app = in_buffer(run=PENDULUM_TOM, weights="region x 4 s0, made", row="5")
    assert any("brush" in note.value for note in app.info)
    assert not any(figure["data"][0]["type"] == "waterfall" for figure in figures(app))


def test_a_small_copy_keeps_the_brush(made: Path, store: Path, tmp_path: Path) -> None:
    there = with_weighing(store, made, tmp_path)
    (copy,) = copy_small(there, PENDULUM_TOM, tmp_path / "copy")
    region = read_table(copy / "weights.parquet")["region"].to_numpy()
    assert region.dtype == np.bool_
    assert region.tolist() == [False] * 150 + [True] * 150
    (brush,) = weighings.of_run(info(there, PENDULUM_TOM), brush=True)
    assert weighings.brushed(replace(brush, path=copy)) is not None


@in_browser
def test_every_factor_has_a_point_and_what_was_not_measured_has_none() -> None:
    factors = (0.0, 0.25, 0.5, 2.0, 4.0)
    errors = {factor: [0.5 + factor, 0.7 + factor] for factor in (*factors, 1.0)}
    region = {factor: [np.nan, np.nan] for factor in errors}
    found = Brushed("b", 10, 100, 300, {}, {REGION: region, REST: errors}, {})
    figure = brushed_errors(found, 300, "dark")
    drawn = figure.to_dict()["data"]
    assert len(drawn) == len({str(of["marker"]["color"]) for of in drawn}) == len(factors)
    ratios = [4.5 / 1.5, 4.7 / 1.7]
    assert array(drawn[-1]["x"]) == pytest.approx([np.mean(ratios)])
    rows = saved(figure).iloc[-1]
    assert rows["line"].startswith("held-out, elsewhere, weight x 4: ")
    assert [rows["low"], rows["high"]] == pytest.approx(sorted(ratios))


@pytest.mark.parametrize(
    ("rows", "said"), [(None, "No such file"), ("", "--rows"), ("1 two", "--rows"), ("300", "299")]
)
def test_rows_that_are_none_are_one_line(
    rows: str | None, said: str, store: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    if rows is not None:
        (tmp_path / "rows").write_text(rows)
    assert (
        main(brush_arguments(PENDULUM_TOM, str(tmp_path / "rows"), FIT, "", (0,), str(store))) == 2
    )
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1
