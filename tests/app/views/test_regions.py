"""Attention in the buffer: the map, the selection and what is in it are the recorded rows."""

from functools import partial
from pathlib import Path

import numpy as np
import pytest
from streamlit.testing.v1 import AppTest
from studio_pages import array, draw, figures
from studio_runs import PENDULUM_TOM, info

from app.data import buffer, regions
from app.data.buffer import WINDOW, Rows, against, rows_at, windows
from app.figures.regions import POINTS, hover_data, region_map, weights_against
from app.scenes import solids, states
from app.views.attention.region_tables import listed
from tom.data.transitions import Transitions, episodes
from tom.envs import scene, task
from tom.record.reader import RunReader
from tom.record.task_record import dimension_names

pytestmark = pytest.mark.usefixtures("studio")
FIT = 300
in_buffer = partial(draw, "attention", part="In the buffer")


@pytest.fixture
def rows(store: Path) -> Rows:
    found = buffer.rows(info(store, PENDULUM_TOM), FIT)
    assert found is not None
    return found


def made(count: int) -> Transitions:
    """Episodes of three steps whose observation counts rows."""
    obs = np.arange(count, dtype=np.float32)[:, None]
    ended = (np.arange(count) % 3 == 2).astype(np.float32)
    return Transitions(obs, obs * 0, np.ones(count, np.float32), obs + 1, ended, ended * 0)


def test_the_rows_of_a_fit_are_the_newest_of_that_step(store: Path, rows: Rows) -> None:
    weight = RunReader(store / PENDULUM_TOM).snapshot(FIT)["weight"].to_numpy()
    recorded = RunReader(store / PENDULUM_TOM).buffer()[0]
    assert len(rows) == len(weight) == FIT
    assert rows.weight == pytest.approx(weight)
    assert np.asarray(rows.rows.obs) == pytest.approx(np.asarray(recorded.obs)[:FIT])


def test_a_full_buffer_has_lost_its_oldest_rows() -> None:
    rows = rows_at(made(10), np.zeros(10, np.int64), np.ones(4), 9)
    assert rows is not None
    assert rows.first == 5
    assert np.asarray(rows.rows.obs)[:, 0].tolist() == [5, 6, 7, 8]
    assert rows.place.tolist() == [2, 0, 1, 2]
    assert rows_at(made(10), np.zeros(10, np.int64), np.ones(4), 11) is None


def test_episodes_are_counted_from_their_ends() -> None:
    number, place, total = episodes(made(7))
    assert number.tolist() == [0, 0, 0, 1, 1, 1, 2]
    assert place.tolist() == [0, 1, 2, 0, 1, 2, 0]
    assert total.tolist() == [3, 3, 3, 3, 3, 3, 1]


def test_an_outline_holds_what_is_inside() -> None:
    corner = [(0.0, 0.0), (4.0, 0.0), (4.0, 4.0), (2.0, 1.0), (0.0, 4.0)]  # a notch from above
    x, y = np.array([1.0, 2.0, 3.0, 5.0, 2.0]), np.array([1.0, 3.0, 2.0, 1.0, 0.5])
    assert regions.inside(corner, x, y).tolist() == [True, False, True, False, True]
    assert not regions.inside([], x, y).any()


def test_principal_components_keep_most_of_the_variance() -> None:
    draw_ = np.random.default_rng(0)
    line = draw_.normal(size=(500, 1)).astype(np.float32)
    noise = 0.1 * draw_.normal(size=(500, 1)).astype(np.float32)
    zero = np.zeros(500, np.float32)
    rows = Transitions(
        np.hstack([line, line * 0]), noise, zero, np.hstack([line, noise]), zero, zero
    )
    plane = regions.principal_plane(rows)
    spread = np.sort([plane.x.var(), plane.y.var()])
    assert spread == pytest.approx([2, 2], rel=0.2)
    assert "50 % of the variance" in plane.x_name


def test_the_summary_is_the_regions(rows: Rows) -> None:
    mask = regions.heaviest(rows.weight, 0.1)
    found = regions.summary(rows, mask)
    assert found["transitions"] == 30
    assert found["mean weight"] == pytest.approx(np.sort(rows.weight)[-30:].mean())
    share = 100 * np.sort(rows.weight)[-30:].sum() / rows.weight.sum()
    assert found["share of the weight, %"] == pytest.approx(share)
    assert np.isnan(regions.summary(rows, mask & ~mask)["mean weight"])
    equal = regions.heaviest(np.ones(10_000), 0.01)
    assert equal.sum() == 100
    assert 3000 < np.flatnonzero(equal).mean() < 7000  # no part of the buffer


def test_an_episode_cut_by_time_has_an_end() -> None:
    ended = np.array([0.0, 0, 1, 0])
    part = made(4)
    cut = Transitions(part.obs, part.action, part.reward, part.next_obs, ended * 0, ended)
    rows = rows_at(cut, np.array([0, 0, 1, 1]), np.ones(4), 4)
    assert rows is not None
    assert regions.summary(rows, np.ones(4, bool))["ends an episode, %"] == 25


def test_data_whose_policies_are_not_known_have_none() -> None:
    rows = rows_at(made(6), np.arange(6), np.ones(6), 6)
    assert rows is not None
    everything = np.ones(6, bool)
    assert np.isnan(regions.summary(rows, everything)[regions.EXPLORED])
    assert set(hover_data(rows, np.arange(6))[:, 3]) == {"policy not known"}
    assert set(listed(rows, np.arange(6), ["x"], ["a"])["policy version"]) == {"not known"}
    collected = rows_at(made(6), np.array([0, 0, 0, 1, 1, 2]), np.ones(6), 6)
    assert collected is not None
    assert regions.summary(collected, everything)[regions.EXPLORED] == 50
    assert list(hover_data(collected, np.arange(2, 4))[:, 3]) == ["exploration", "policy 1"]


def test_what_sets_a_region_apart_is_named(rows: Rows) -> None:
    names, actions = dimension_names("inverted-pendulum", rows.rows)
    angle = np.asarray(rows.rows.obs)[:, 1]
    name, gap = regions.apart(rows, angle > np.quantile(angle, 0.9), names + actions)[0]
    assert name == "pole angle"
    assert gap > 1


def test_only_dimensions_of_road_and_rocks_are_called_x_and_y() -> None:
    two, one = np.zeros((3, 2)), np.zeros(3)
    plane = Transitions(two, two, one, two, one, one)
    assert dimension_names("road-and-rocks", plane)[0] == ["x", "y"]
    others = "gymnasium:MountainCarContinuous-v0"
    assert dimension_names(others, plane)[0] == ["observation 1", "observation 2"]
    assert dimension_names(others, plane, ("position", "velocity"))[0] == ["position", "velocity"]


def test_picks_keep_their_distance(rows: Rows) -> None:
    everything = np.ones(len(rows), bool)
    heavy, light = regions.heavy_and_light(rows, everything, 5, 10)
    assert heavy[0] == rows.weight.argmax()
    assert rows.weight[light].max() <= rows.weight[heavy].min()
    assert min(abs(a - b) for a in heavy for b in heavy if a != b) >= 10


def test_weights_against_a_quantity_lose_nothing() -> None:
    quantity, weight = np.repeat([1.0, 2.0, 3.0], [80, 10, 10]), np.linspace(0, 2, 100)
    found = against(quantity, weight, 10)
    assert found.x.tolist() == [1, 2, 3] or found.x.tolist() == pytest.approx([1, 2.5])
    assert found.mean[0] == pytest.approx(weight[:80].mean())
    line = weights_against(found, "tom", "thing", 200).data[0]
    assert list(line.y) == pytest.approx(found.mean)  # type: ignore[attr-defined]


def test_a_large_map_is_thinned_and_says_so() -> None:
    plane = regions.Plane(np.arange(20_000.0), np.zeros(20_000), "a", "b")
    zeros, ones = np.zeros(20_000, np.int64), np.ones(20_000)
    many = Transitions(*[ones] * 6)
    rows = Rows(0, many, zeros, zeros, zeros, ones, ones)
    figure = region_map(plane, rows, ones > 0, [], "light", 300, "k")
    assert len(figure.data[0].x) == POINTS  # type: ignore[attr-defined]
    assert "8,000 of 20,000" in figure.to_dict()["layout"]["annotations"][0]["text"]


def test_a_map_marks_the_region_and_tells_of_each_point(rows: Rows) -> None:
    app = in_buffer(run=PENDULUM_TOM, step=str(FIT))
    cloud, ringed = figures(app)[0]["data"]
    heaviest = np.flatnonzero(regions.heaviest(rows.weight, 0.01))
    plane = regions.principal_plane(rows.rows)
    assert sorted(array(cloud["x"])) == pytest.approx(sorted(plane.x), abs=1e-4)
    assert sorted(array(ringed["x"])) == pytest.approx(sorted(plane.x[heaviest]), abs=1e-4)
    for step, episode, place, phase, reward, weight in cloud["customdata"][:50]:
        row = step - 1 - rows.first
        assert episode - 1 == rows.episode[row]
        assert place - 1 == rows.place[row]
        assert (phase == "exploration") == (rows.version[row] == 0)
        assert reward == pytest.approx(float(np.asarray(rows.rows.reward)[row].item()))
        assert weight == pytest.approx(rows.weight[row])
    table = app.dataframe[0].value.set_index("")
    three = np.sort(rows.weight)[-3:]
    assert table.loc["transitions", "region"] == "3"
    assert table.loc["mean weight", "region"] == f"{three.mean():,.2f}"
    assert app.dataframe[1].value["weight"].tolist() == pytest.approx(three[::-1])
    whole = figures(in_buffer(run=PENDULUM_TOM, step=str(FIT), region="everything"))[0]
    assert not len(array(whole["data"][1]["x"]))  # to mark all is to mark nothing


def test_the_page_shows_a_drawn_region(rows: Rows) -> None:
    obs = np.asarray(rows.rows.obs)
    x, y = np.median(obs[:, 0]), 9.0
    box = f"{x},-9;9,-9;9,{y};{x},{y}"
    query = {"across": "cart x", "up": "pole angle", "region": "what I draw", "outline": box}
    app = in_buffer(run=PENDULUM_TOM, step=str(FIT), **query)
    table = app.dataframe[0].value.set_index("")
    assert table.loc["transitions", "region"] == str((obs[:, 0] > x).sum())
    assert figures(app)[0]["layout"]["shapes"][0]["type"] == "path"


def test_an_outline_is_dropped_where_its_axes_change(rows: Rows) -> None:
    query = {"region": "what I draw", "outline": "-9,-9;9,-9;9,9;-9,9", "across": "cart x"}
    app = in_buffer(run=PENDULUM_TOM, step=str(FIT), up="pole angle", **query)
    assert chosen(app) == len(rows)
    app.selectbox(key="up").select("cart velocity").run()
    assert chosen(app) == 0
    assert "outline" not in app.query_params
    assert "shapes" not in figures(app)[0]["layout"]


def test_an_outline_over_components_belongs_to_one_fit(rows: Rows) -> None:
    query = {"region": "what I draw", "outline": "-99,-99;99,-99;99,99;-99,99"}
    app = in_buffer(run=PENDULUM_TOM, step=str(FIT), **query)
    assert chosen(app) == len(rows)
    here = {name: str(app.query_params[name]) for name in ("outline", "axes")}
    query = {"region": "what I draw", **here}
    assert chosen(in_buffer(run=PENDULUM_TOM, step=str(FIT), **query)) == len(rows)
    assert chosen(in_buffer(run=PENDULUM_TOM, step="200", **query)) == 0
    query = {"region": "what I draw", "outline": "1,nan;x"}
    assert chosen(in_buffer(run=PENDULUM_TOM, **query)) == 0


def chosen(app: AppTest) -> int:
    return int(app.dataframe[0].value.set_index("").loc["transitions", "region"])


def test_a_part_of_the_buffer_by_age(rows: Rows) -> None:
    app = in_buffer(run=PENDULUM_TOM, step=str(FIT), region="an age")
    app.slider(key="age").set_value((0, 50)).run()
    table = app.dataframe[0].value.set_index("")
    assert table.loc["transitions", "region"] == "150"
    assert table.loc["mean weight", "region"] == f"{rows.weight[:150].mean():,.2f}"


def test_a_moment_stays_in_its_episode() -> None:
    ended = np.zeros(60, bool)
    ended[[9, 29]] = True
    found = windows(ended, [12, 59])
    assert found.shape == (2, 2 * WINDOW + 1)
    assert found[0, WINDOW] == 12
    assert found[0].min() == 10
    assert found[0].max() == 24
    assert found[1].max() == 59


def test_robots_stand_as_they_were_recorded(store: Path, rows: Rows) -> None:
    recorded = RunReader(store / PENDULUM_TOM).buffer()[0]
    ended = (np.asarray(recorded.terminated) != 0) | (np.asarray(recorded.truncated) != 0)
    found = states.poses(task("inverted-pendulum"), recorded, {}, windows(ended, [7, 200]))
    assert found[:, WINDOW] == pytest.approx(np.asarray(recorded.obs)[[7, 200], :2])
    robots = solids.of(scene.model("inverted-pendulum"), found)
    position, wxyz = robots.position[:, WINDOW], robots.wxyz[:, WINDOW]
    assert position.shape == (2, 3, 3)
    assert np.linalg.norm(wxyz, axis=-1) == pytest.approx(1)
    kept = {"qpos": np.asarray(recorded.obs)[:, :2] + 5}
    assert states.poses(task("hopper"), recorded, kept, windows(ended, [7]))[0, WINDOW, 0] == 0


def test_at_an_evaluation_the_buffer_is_that_of_the_last_fit_before(store: Path) -> None:
    last = RunReader(store / PENDULUM_TOM).evaluation_steps()[-1]
    assert last > FIT
    app = in_buffer(run=PENDULUM_TOM, step=str(last))
    assert app.dataframe[0].value.set_index("").loc["transitions", "buffer"] == str(FIT)
