"""Attention on road-and-rocks: the weights over the map, and several runs side by side."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from studio_pages import array, draw, figures, metrics, recorded, set_links, trace
from studio_runs import ROAD_MLE, ROAD_TOM, altered, info

from app.data import road
from app.data.called import names, short_names, task, told_apart
from app.links import Links
from app.theme import COLUMNS, DIVERGING, rgb
from app.views.attention.road import BESIDE
from tom.record.export import export_small
from tom.record.labels import Labels
from tom.record.reader import RunReader

pytestmark = pytest.mark.usefixtures("studio")


def test_the_weights_and_the_policy_lie_over_the_map(store: Path) -> None:
    app = draw("attention", run=ROAD_TOM)
    (figure,) = figures(app)
    heat = trace(figure, name="weights")
    weight = RunReader(store / ROAD_TOM).snapshot(60)["weight"].to_numpy()
    assert np.nanmax(array(heat["customdata"])) <= weight.max() + 1e-5
    share = recorded(store, ROAD_TOM, "weights/road_share")[1][-1]
    assert metrics(app)["weight on the road"] == f"{100 * share:.1f} %"
    table = app.dataframe[0].value.set_index("run")
    assert table.loc[ROAD_TOM, "weight on the road"] == pytest.approx(share)
    assert table.loc[ROAD_MLE, "road : rocks, random data"] == pytest.approx(1, abs=0.01)
    policy = trace(figures(draw("attention", run=ROAD_TOM, step="0"))[0], name="TOM policy")
    first = RunReader(store / ROAD_TOM).field("trajectories", 0)["learnt_0"]
    assert array(policy["x"])[: len(first)] == pytest.approx(first[:, 0])


def test_two_runs_are_drawn_side_by_side_on_one_scale(store: Path) -> None:
    app = draw("attention", run=ROAD_TOM, beside=ROAD_MLE, step="60")
    maps = [trace(figure, name="weights") for figure in figures(app)]
    assert {(each["zmin"], each["zmax"]) for each in maps} == {(-4, 4)}
    assert maps[0]["colorbar"]["tickvals"] == maps[1]["colorbar"]["tickvals"]
    tom, mle = (array(each["customdata"]) for each in maps)
    for shown, run_id in ((tom, ROAD_TOM), (mle, ROAD_MLE)):
        picture = road.picture(RunReader(store / run_id), 60)
        assert picture is not None
        assert shown == pytest.approx(picture.grid, nan_ok=True)
    assert np.nanmax(tom) > 2
    assert np.nanmax(mle) == pytest.approx(1)


def test_more_runs_than_stand_beside_are_cut_to_those_that_do(own: Path) -> None:
    ids = [f"road-{i}" for i in range(BESIDE + 2)]
    for run_id in ids:
        shutil.copytree(own / ROAD_MLE, own / run_id)
    app = draw("attention", run=ids[0], beside=ids[1:])
    assert app.multiselect(key="beside").value == ids[1:-1]
    assert app.query_params["beside"] == ids[1:-1]


def test_a_copy_without_its_buffer_says_what_was_recorded_of_the_road(
    store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = metrics(draw("attention", run=ROAD_TOM, step="60"))["weight on the road"]
    export_small(RunReader(store / ROAD_TOM), tmp_path, without=["buffer"])
    set_links(Links(store=str(tmp_path), key="key"), monkeypatch)
    assert metrics(draw("attention", run=ROAD_TOM, step="60"))["weight on the road"] == whole
    assert float(whole.split()[0]) > 0


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
