"""Road and rocks: several runs side by side, each with its own weights."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from streamlit.testing.v1 import AppTest
from studio_pages import array, draw, figures, set_links, trace
from studio_runs import PENDULUM_TOM, ROAD_MLE, ROAD_TOM, altered, info

from app.data import road
from app.data.called import names, short_names, task, told_apart
from app.links import Links
from app.scenes.colours import rgb
from app.theme import COLUMNS, DIVERGING
from app.views.road import BESIDE
from tom.record.export import export_small
from tom.record.labels import Labels
from tom.record.reader import RunReader

pytestmark = pytest.mark.usefixtures("studio")


def weights_shown(app: AppTest) -> list[np.ndarray]:
    return [array(trace(figure, name="weights")["customdata"]) for figure in figures(app)]


def test_two_runs_are_drawn_side_by_side(store: Path) -> None:
    app = draw("road", run=ROAD_TOM, beside=ROAD_MLE, step="60")
    tom, mle = weights_shown(app)
    for shown, run_id in ((tom, ROAD_TOM), (mle, ROAD_MLE)):
        picture = road.picture(RunReader(store / run_id), 60)
        assert picture is not None
        assert shown == pytest.approx(picture.grid, nan_ok=True)
    assert np.nanmax(tom) > 2
    assert np.nanmax(mle) == pytest.approx(1)


def test_more_runs_than_stand_beside_are_cut_to_those_that_do(
    store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ids = [f"road-{i}" for i in range(BESIDE + 2)]
    for run_id in ids:
        shutil.copytree(store / ROAD_MLE, tmp_path / run_id)
    set_links(Links(store=str(tmp_path), key="key"), monkeypatch)
    app = draw("road", run=ids[0], beside=ids[1:])
    assert app.multiselect(key="beside").value == ids[1:-1]
    assert app.query_params["beside"] == ids[1:-1]


def test_a_copy_without_its_buffer_says_what_was_recorded_of_the_road(
    store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def on_the_road() -> str:
        app = draw("road", run=ROAD_TOM, step="60")
        return next(one.value for one in app.metric if one.label == "weight on the road")

    whole = on_the_road()
    export_small(RunReader(store / ROAD_TOM), tmp_path, without=["buffer"])
    set_links(Links(store=str(tmp_path), key="key"), monkeypatch)
    assert on_the_road() == whole
    assert float(whole.split()[0]) > 0


def test_maps_side_by_side_have_one_scale_and_names_that_tell_them_apart() -> None:
    app = draw("road", run=ROAD_TOM, beside=ROAD_MLE, step="60")
    maps = [trace(figure, name="weights") for figure in figures(app)]
    assert {(each["zmin"], each["zmax"]) for each in maps} == {(-4, 4)}
    assert {str(each["colorbar"]["tickvals"]) for each in maps} == {
        str(maps[0]["colorbar"]["tickvals"])
    }
    names = [words.value for words in app.markdown if "step 60" in words.value]
    assert names == ["**TOM s0**, step 60", "**MLE s0**, step 60"]


def test_runs_that_would_be_called_the_same_are_told_apart(store: Path) -> None:
    tom, mle = (RunReader(store / run_id) for run_id in (ROAD_TOM, ROAD_MLE))
    assert told_apart([tom, mle]) == {ROAD_TOM: "TOM s0", ROAD_MLE: "MLE s0"}
    twin = altered(info(store, ROAD_TOM), run_id="twin")
    assert told_apart([tom, mle, twin]) == {
        ROAD_TOM: f"TOM s0, {ROAD_TOM}",
        ROAD_MLE: "MLE s0",
        "twin": "TOM s0, twin",
    }
    other = altered(twin, settings={**twin.settings, "tom.flow": "restart"})
    ours = info(store, ROAD_TOM)
    named = [altered(run, labels=Labels(name="the good one")) for run in (ours, other)]
    assert short_names([*named, mle]) == {
        ROAD_TOM: "the good one",
        "twin": "the good one, tom.flow restart",
        ROAD_MLE: "MLE s0",
    }
    assert told_apart([tom, other]) == {ROAD_TOM: "TOM s0", "twin": "TOM s0, tom.flow restart"}
    assert names([tom, other])["twin"] == "Road and rocks · TOM · seed 0, tom.flow restart"
    robot = altered(twin, run_id="robot", env="walker2d")
    assert told_apart([mle, robot]) == {
        ROAD_MLE: "Road and rocks MLE s0",
        "robot": "Walker2d TOM s0",
    }
    assert [task(env) for env in ("halfcheetah", "ant")] == ["HalfCheetah", "Ant"]


def test_in_either_theme_the_scene_and_the_map_agree_on_what_is_bright() -> None:
    for mode in ("light", "dark"):
        light = [[sum(rgb(colour)) for _, colour in of[mode]] for of in (DIVERGING, COLUMNS)]
        assert len({columns[-1] > columns[0] for columns in light}) == 1


def test_steps_of_the_road_are_called_what_they_are() -> None:
    live = [
        figure["layout"]["xaxis"]["title"]["text"]
        for figure in figures(draw("live", runs=ROAD_TOM))
    ]
    assert live[0] == "steps of policy optimisation"
    compare = figures(draw("compare", env="inverted-pendulum"))[0]
    assert compare["layout"]["xaxis"]["title"]["text"] == "env steps"


def test_one_run_has_one_map() -> None:
    assert len(weights_shown(draw("road", run=ROAD_MLE))) == 1


def test_the_scene_can_be_shared() -> None:
    button = draw("road", run=ROAD_TOM).get("download_button")[0]
    assert "HTML" in button.proto.label


def test_without_a_run_the_page_names_a_command_for_this_store(
    store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(store / PENDULUM_TOM, tmp_path / PENDULUM_TOM)
    set_links(Links(store=str(tmp_path), key="key"), monkeypatch)
    (code,) = draw("road").code
    assert code.value.endswith(f"--store {tmp_path}")
