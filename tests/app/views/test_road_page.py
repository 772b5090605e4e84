"""Attention on road-and-rocks: the weights over the map, and several runs side by side."""

from pathlib import Path

import numpy as np
import pytest
from common import present
from studio_pages import array, draw, figures, parts, trace
from studio_runs import ROAD_MLE, ROAD_TOM, altered, info

from app.data import road
from app.data.run_names import distinct_names, full_names, task_title
from app.theme import COLUMNS, DIVERGING, rgb
from tom.readable import percent
from tom.record.reader import RunReader
from tom.record.status import Labels

pytestmark = pytest.mark.usefixtures("studio")


def test_the_weights_and_the_policy_lie_over_the_map(store: Path) -> None:
    app = draw("attention", run=ROAD_TOM)
    figure = figures(app)[0]
    heat = trace(figure, name="weights")
    weight = RunReader(store / ROAD_TOM).snapshot(60)["weight"].to_numpy()
    assert np.nanmax(array(heat["customdata"])) <= weight.max() + 1e-5
    picture = present(road.picture(RunReader(store / ROAD_TOM), 60))
    moves = trace(figure, name="modelled move")
    (x, to_x), (y, to_y) = (array(moves[axis])[:2] for axis in "xy")
    assert (to_x - x, to_y - y) == pytest.approx(picture.modelled[0], abs=1e-6)
    (shown,) = parts(app, "tom_readout")
    numbers = {number["label"]: number["values"] for number in shown["numbers"]}
    obs = np.asarray(RunReader(store / ROAD_TOM).buffer()[0].obs)
    there = road.on_road(obs, road.RoadShape.of(RunReader(store / ROAD_TOM).field("map", 0)))
    share = weight[there].sum() / weight.sum()
    assert numbers["weight on the road"] == [percent(share)] * len(shown["steps"])  # one fit of all
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
        picture = present(road.picture(RunReader(store / run_id), 60))
        assert shown == pytest.approx(picture.grid, nan_ok=True)
    assert np.nanmax(tom) > 2
    assert np.nanmax(mle) == pytest.approx(1)


def test_runs_that_would_be_called_the_same_are_told_apart(store: Path) -> None:
    tom, mle = (RunReader(store / run_id) for run_id in (ROAD_TOM, ROAD_MLE))
    assert distinct_names([tom, mle]) == {ROAD_TOM: "TOM s0", ROAD_MLE: "MLE s0"}
    twin = altered(info(store, ROAD_TOM), run_id="twin")
    assert distinct_names([tom, mle, twin]) == {
        ROAD_TOM: f"TOM s0, {ROAD_TOM}",
        ROAD_MLE: "MLE s0",
        "twin": "TOM s0, twin",
    }
    other = altered(twin, settings={**twin.settings, "tom.flow": "restart"})
    ours = info(store, ROAD_TOM)
    named = [altered(run, labels=Labels(name="the good one")) for run in (ours, other)]
    assert distinct_names([*named, mle], by_user=True) == {
        ROAD_TOM: "the good one",
        "twin": "the good one, tom.flow restart",
        ROAD_MLE: "MLE s0",
    }
    assert distinct_names([tom, other]) == {ROAD_TOM: "TOM s0", "twin": "TOM s0, tom.flow restart"}
    assert full_names([tom, other])["twin"] == "Road and rocks · TOM · seed 0, tom.flow restart"
    robot = altered(twin, run_id="robot", env="walker2d")
    assert distinct_names([mle, robot]) == {
        ROAD_MLE: "Road and rocks MLE s0",
        "robot": "Walker2d TOM s0",
    }
    assert [task_title(env) for env in ("halfcheetah", "ant")] == ["HalfCheetah", "Ant"]


def test_in_either_theme_the_scene_and_the_map_agree_on_what_is_bright() -> None:
    for mode in ("light", "dark"):
        light = [[sum(rgb(colour)) for _, colour in of[mode]] for of in (DIVERGING, COLUMNS)]
        assert len({columns[-1] > columns[0] for columns in light}) == 1
