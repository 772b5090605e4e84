"""Attention in the buffer: the map, the selection and what it chooses are the recorded rows."""

import shutil
from dataclasses import replace
from pathlib import Path
from queue import SimpleQueue

import numpy as np
import pytest
import torch
from common import present
from numpy.typing import NDArray
from streamlit.testing.v1 import AppTest
from studio_pages import Show, draw, hear, in_buffer, map_of, metrics
from studio_runs import PENDULUM_TOM, ROAD_TOM, info, trains_elsewhere

from app.data import buffer, buffer_map, cache, columns, why
from app.data.buffer import WINDOW, Rows, poses, windows
from app.data.columns import Column
from app.data.selection import Selection, between, inside
from app.parts import timeline
from app.scenes import control, solids
from app.views.attention.in_buffer import row_table, table
from tom.analysis import why as reasons
from tom.envs import scene, task
from tom.record import Store, layout
from tom.record.export import export_small
from tom.record.reader import RunReader
from tom.training.presets import resolve
from tom.training.run import train

pytestmark = pytest.mark.usefixtures("studio")
FIT = 300


def rows_of_fit(run: RunReader) -> Rows:
    end = run.profiles().rows_at(FIT)
    return present(buffer.weighed_rows(run, buffer.fit_weight(run, FIT), end))


@pytest.fixture
def rows(store: Path) -> Rows:
    return rows_of_fit(info(store, PENDULUM_TOM))


def test_the_robots_are_those_of_the_timelines_fit(store: Path, tmp_path: Path, show: Show) -> None:
    told: SimpleQueue[control.Selection] = SimpleQueue()
    socket = str(tmp_path / "control")
    hear(socket, lambda _, selection: told.put(selection))
    show(store, port=1, folder=str(tmp_path))
    fits = RunReader(store / PENDULUM_TOM).snapshot_steps()
    app = in_buffer(run=PENDULUM_TOM, step=str(fits[0]))
    for fit in (fits[0], fits[-1]):
        if fit != fits[0]:
            app.session_state[timeline.STEP] = fit
            app.run()
        weight = RunReader(store / PENDULUM_TOM).snapshot(fit)["weight"].to_numpy()
        choice = told.get(timeout=20).choice
        assert isinstance(choice, control.StatesChoice)
        (_, heavy, weights), _ = choice.groups
        assert weights == pytest.approx(weight[list(heavy)], abs=1e-4)
        assert weights[0] == pytest.approx(weight.max(), abs=1e-4)


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
    found = poses(task("inverted-pendulum"), recorded, {}, windows(ended, [7, 200]))
    assert found[:, WINDOW] == pytest.approx(np.asarray(recorded.obs)[[7, 200], :2])
    robots = solids.robot_solids(scene.model("inverted-pendulum"), found)
    position, wxyz = robots.position[:, WINDOW], robots.wxyz[:, WINDOW]
    assert position.shape == (2, 3, 3)
    assert np.linalg.norm(wxyz, axis=-1) == pytest.approx(1)
    kept = {"qpos": np.asarray(recorded.obs)[:, :2] + 5}
    assert poses(task("hopper"), recorded, kept, windows(ended, [7]))[0, WINDOW, 0] == 0


def chosen(app: AppTest) -> list[int]:
    """The recorded numbers of the chosen rows, as the page's table has them (at most 300)."""
    return sorted(app.dataframe[0].value["row"])


def selected(store: Path, *where: str, outline: str = "", fit: int = FIT) -> list[int]:
    """The recorded numbers of the rows that the words of an address choose."""
    run = info(store, PENDULUM_TOM)
    source = buffer_map.sources(run)[str(fit)]
    mask = buffer_map.selection_mask(run, source, Selection.of(where, [outline]))
    return (source.first + np.flatnonzero(mask)).tolist()


def published(url: str) -> NDArray[np.uint16]:
    """The array that the browser gets at an address of the page."""
    return np.frombuffer(present(cache.published_array(url.rpartition("/")[2])), np.uint16)


def test_an_outline_holds_what_is_inside() -> None:
    corners = [(0.0, 0.0), (4.0, 0.0), (4.0, 4.0), (2.0, 1.0), (0.0, 4.0)]  # a notch from above
    x, y = np.array([1.0, 2.0, 3.0, 5.0, 2.0]), np.array([1.0, 3.0, 2.0, 1.0, 0.5])
    assert inside(corners, x, y).tolist() == [True, False, True, False, True]


def test_codes_keep_the_order_and_the_ends() -> None:
    values = np.random.default_rng(0).normal(size=2000)
    codes = columns.encode(values, Column("", -1.0, 1.0))
    back = columns.decode(codes, Column("", -1.0, 1.0))
    assert back == pytest.approx(values.clip(-1, 1), abs=2e-5)
    column = columns.Column("x", -1.0, 1.0)
    assert between(codes, column, (0.25, None)).sum() == (values >= 0.25).sum()
    assert between(codes, column, (None, None)).all()
    unknown = columns.encode(np.array([0.5, np.nan]), Column("", 0.0, 1.0))
    assert between(unknown, columns.Column("x", 0.0, 1.0), (None, 1.0)).tolist() == [True, False]


def test_codes_of_weights_keep_zero_apart_and_the_rest_to_a_thousandth() -> None:
    weight = np.concatenate([np.zeros(5), np.random.default_rng(0).lognormal(0, 2, 500)])
    codes = columns.weight_codes(weight)
    assert ((codes == 0) == (weight == 0)).all()
    octave = (codes[5:] - 1.0) / (columns.TOP - 1) * 2 * columns.OCTAVES - columns.OCTAVES
    assert 2**octave == pytest.approx(weight[5:] / weight.mean(), rel=1e-3)
    rank = columns.rank_codes(columns.weight_codes(np.arange(1.0, 1001)))
    assert between(rank, columns.RANK, (99, None)).sum() == 10
    equal = columns.rank_codes(columns.weight_codes(np.ones(100)))
    assert between(equal, columns.RANK, (99, None)).all()


def test_intervals_and_presets_of_an_address_choose_the_rows(rows: Rows, store: Path) -> None:
    angle = np.asarray(rows.rows.obs)[:, 1]
    middle = float(f"{np.median(angle):.4g}")
    higher, old = f"pole angle {middle}..", "age ..50"
    expected = (rows.first + np.flatnonzero(angle >= middle)).tolist()
    assert selected(store, higher) == expected
    assert chosen(in_buffer(run=PENDULUM_TOM, step=str(FIT), where=higher)) == expected
    assert selected(store, old) == list(range(rows.first, rows.first + 150))
    heaviest = rows.first + np.argsort(rows.weight)[-3:]
    assert selected(store, "weight rank 99..") == sorted(heaviest)
    zero = rows.first + np.flatnonzero(rows.weight == 0)
    assert selected(store, "weight ..0") == zero.tolist()
    both = (rows.first + np.flatnonzero(angle[:150] >= middle)).tolist()
    assert selected(store, higher, old) == both
    for malformed in ("pole angle x..1", "nothing 1..2", "1..2", "age"):
        assert len(selected(store, malformed)) == FIT


def test_an_outline_keeps_its_rows_on_every_plane(rows: Rows, store: Path) -> None:
    obs = np.asarray(rows.rows.obs)
    x = float(np.median(obs[:, 0]))
    outline = f"two@cart x|pole angle {x:.6g},-9;9,-9;9,9;{x:.6g},9"
    expected = (rows.first + np.flatnonzero(obs[:, 0] > float(f"{x:.6g}"))).tolist()
    for plane in ("contrast", "two"):
        app = in_buffer(run=PENDULUM_TOM, step=str(FIT), outline=outline, plane=plane)
        assert len(np.setxor1d(chosen(app), expected)) <= 1  # a row on the border
        assert app.query_params["outline"] == outline
    for malformed in ("1,nan;x", "two@a|b 0,0;1,1;2,2", "contrast@9 0,0;1,1"):
        assert len(selected(store, outline=malformed)) == FIT


def test_a_training_may_replace_its_newest_fit_before_the_browser_asks_for_it(own: Path) -> None:
    run = own / PENDULUM_TOM
    trains_elsewhere(run)
    given = map_of(in_buffer(run=PENDULUM_TOM))
    newest = given["sources"][-1]
    (run / layout.snapshot(newest["step"])).unlink()
    (run / layout.policy(newest["step"])).unlink(missing_ok=True)
    urls = [newest["url"], newest["distance"], *(one["url"] for one in given["planes"][0]["axes"])]
    for url in urls:
        assert len(published(url)) >= newest["count"]
    outline = f"{given['planes'][0]['key']} 0,-99;99,-99;99,99;0,99"
    earlier = given["sources"][0]
    assert 0 < len(selected(own, outline=outline, fit=earlier["step"])) < earlier["count"]


def test_map_and_file_have_one_policy_distance_that_of_the_fits_own_policy(store: Path) -> None:
    run = info(store, PENDULUM_TOM)
    given = {one["step"]: one for one in map_of(in_buffer(run=PENDULUM_TOM))["sources"]}
    distances = []
    for fit in RunReader(store / PENDULUM_TOM).policy_steps():
        far = columns.decode(published(given[fit]["distance"]), columns.DISTANCE)
        saved = table(run, buffer_map.sources(run)[str(fit)])["policy_distance"].to_numpy()
        assert far == pytest.approx(saved, abs=1e-4)
        near = selected(store, "policy distance ..0.5", fit=fit)
        assert near == np.flatnonzero(saved <= 0.5).tolist()
        distances.append(far)
    assert len(distances) == 2
    assert distances[0] != pytest.approx(distances[1][: len(distances[0])], abs=1e-3)


def test_the_plane_stays_while_the_timeline_moves(store: Path) -> None:
    fits = RunReader(store / PENDULUM_TOM).snapshot_steps()
    app = in_buffer(run=PENDULUM_TOM, step=str(fits[0]))
    stays = map_of(app)["planes"][0]["key"]
    assert stays == f"contrast@{fits[-1]}"
    [button] = [one for one in app.button if one.label == "Plane of this fit"]
    button.click().run()
    assert map_of(app)["planes"][0]["key"] == f"contrast@{fits[0]}"
    assert app.query_params["of"] == str(fits[0])


@pytest.mark.parametrize("kind", ["policy", "model"])
def test_a_network_has_a_plane_of_what_it_sees(rows: Rows, store: Path, kind: str) -> None:
    [plane] = map_of(in_buffer(run=PENDULUM_TOM, step=str(FIT), plane=kind))["planes"]
    assert plane["key"] == f"{kind}@"
    place = present(buffer_map.rows_on_plane(info(store, PENDULUM_TOM), plane["key"]))
    assert np.ptp(place.xy, axis=0).min() > 0
    x, y = place.xy.T - place.xy.mean(0)[:, None]
    assert abs(x @ y) < 1e-3 * np.sqrt((x @ x) * (y @ y))  # as of principal components


def test_a_buffer_that_was_read_ahead_is_not_read_again(
    store: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    buffer_map.read_ahead(info(store, PENDULUM_TOM))
    monkeypatch.setattr(RunReader, "recorded", lambda *_, **__: pytest.fail("read again"))
    assert map_of(in_buffer(run=PENDULUM_TOM))["planes"]


@pytest.mark.parametrize("count", [1, 40, 400, 5000])
def test_the_heaviest_and_lightest_are_those_of_all_rows_in_order(rows: Rows, count: int) -> None:
    rng = np.random.default_rng(count)
    for weight in (rng.lognormal(0, 2, count), np.ones(count), rng.integers(0, 3, count) / 1.0):
        mask = rng.random(count) < 0.7
        picked = buffer.heavy_and_light(replace(rows, weight=weight), mask, 9, 10)
        for found, size in zip(picked, (weight, -weight), strict=True):
            free = np.flatnonzero(mask)  # those that no picked row keeps out
            for row in found:
                assert size[row] == size[free].max()
                assert row in free
                free = free[np.abs(free - row) >= 10]
            assert len(found) == 9 or not len(free)


def test_a_row_has_its_episode_and_its_nearest(rows: Rows) -> None:
    given = map_of(in_buffer(run=PENDULUM_TOM, step=str(FIT), row=str(rows.first + 7)))
    same = rows.first + np.flatnonzero(rows.episode == rows.episode[7])
    assert given["path"] == [same[0], same[-1]]
    move = np.asarray(rows.rows.next_obs) - rows.rows.obs
    part = np.concatenate([rows.rows.obs, rows.rows.action, move], 1)
    gap = np.square((part - part[7]) / part.std(0)).sum(1)
    assert len(given["near"]) == 10
    assert len(set(given["near"]) & set(rows.first + np.argsort(gap)[1:11])) >= 8  # of other scales


def test_a_chosen_row_stays_chosen_while_an_earlier_fit_is_shown(store: Path) -> None:
    first, *_, last = RunReader(store / PENDULUM_TOM).snapshot_steps()
    row = RunReader(store / PENDULUM_TOM).profiles().rows_at(last) - 1
    app = in_buffer(run=PENDULUM_TOM, step=str(last), row=str(row))
    for step, shown in ((first, None), (last, row)):
        app.session_state[timeline.STEP] = step
        app.run()
        assert map_of(app)["row"] == shown
        assert app.query_params["row"] == str(row)
        assert not app.exception


# Why this weight: the page's sum is the weight that is recorded


def of_fit(run: RunReader, fit: int = FIT) -> tuple[Rows, why.Why]:
    """The rows of a fit, and why they have their weights."""
    rows, found = asked(run, fit)
    assert isinstance(found, why.Why)
    return rows, found


def asked(run: RunReader, fit: int = FIT) -> tuple[Rows, why.Why | str]:
    source = buffer_map.sources(run)[str(fit)]
    rows = present(buffer.weighed_rows(run, source.weight, source.end))
    return rows, why.why_of(run, source)


def test_a_kept_fit_has_the_terms_of_its_weights(store: Path) -> None:
    rows, found = of_fit(info(store, PENDULUM_TOM))
    assert len(found.policy_rows) == 100  # 200 steps of exploration came before
    for row in range(0, FIT, 17):
        assert found.sum_of(row).weight == pytest.approx(rows.weight[row], abs=1e-5)


def test_a_fits_own_rows_are_not_compared_with_themselves(store: Path) -> None:
    rows, found = of_fit(info(store, PENDULUM_TOM))
    replay = rows.rows.torch()
    near = why.neighbours(rows, found, FIT - 1)
    others = reasons.nearest(replay, FIT - 1, replay[200 : FIT - 1])
    assert near.near.distance.tolist() == pytest.approx(others.distance.tolist())
    assert near.near.distance[0] > 0
    usual = reasons.usual_distance(replay, replay[200:], torch.arange(200))
    assert near.usual == pytest.approx(usual)
    assert near.own > 0


def test_a_small_copy_has_the_terms_of_its_weights(store: Path, tmp_path: Path) -> None:
    for name, fit in ((PENDULUM_TOM, FIT), (ROAD_TOM, 60)):
        export_small(RunReader(store / name), tmp_path)
        run = info(tmp_path, name)
        rows, found = of_fit(run, fit)
        for row in range(0, len(rows), 17):
            assert found.sum_of(row).weight == pytest.approx(rows.weight[row], rel=0.01, abs=0.01)


def test_the_roads_policy_rows_are_its_footprint(store: Path) -> None:
    run = info(store, ROAD_TOM)
    rows, found = of_fit(run, 60)
    shown = RunReader(store / ROAD_TOM).field("data", 0)["footprint"]
    assert 0 < shown.sum() < 100
    np.testing.assert_array_equal(found.policy_rows.obs.numpy(), np.asarray(rows.rows.obs)[shown])


def test_what_was_recorded_after_a_row_ends_with_its_episode(rows: Rows, store: Path) -> None:
    ended = np.flatnonzero(np.asarray(rows.rows.terminated) != 0)
    assert len(why.recorded_after(rows, int(ended[0]))) == 2
    assert len(why.recorded_after(rows, int(ended[0]) - 1)) == 3


def test_starts_of_rollouts_are_drawn_as_the_run_draws_them(tmp_path: Path) -> None:
    run_ids = {}
    for learner, rollout in (("vagram", {}), ("pmac", {"uniform_share": 0.5})):
        settings = {"steps": 400, "rollout": {"starts": 1000, **rollout}}
        config = resolve("inverted-pendulum", learner, "smoke", settings)
        run_ids[learner] = train(config, Store(tmp_path), rerun=False).run_id
    for learner, run_id in run_ids.items():
        run = info(tmp_path, run_id)
        rows = rows_of_fit(run)
        row = int(rows.weight.argmax())
        assert rows.weight[row] > 1.1
        # VaGram's weights scale the loss, so its rollouts start anywhere.
        share = 0.0 if learner == "vagram" else 0.5
        expected = 1000 / 300 * (1 + share * (rows.weight[row] - 1))
        assert why.starts(run, rows, row) == pytest.approx((expected, 1000 / 300), rel=1e-4)


def test_every_neighbour_has_a_column_however_near_to_the_next(store: Path) -> None:
    rows, found = of_fit(info(store, PENDULUM_TOM))
    near = why.neighbours(rows, found, 5)
    crowd = replace(near.near, distance=near.near.distance * 0 + 0.51)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(why, "neighbours", lambda *_: replace(near, near=crowd))
        app = draw("attention", run=PENDULUM_TOM, step=str(FIT), row="5")
    (table,) = [part.value for part in app.dataframe if "this one" in part.value]
    shown = table[[f"{i + 1}: at 0.51" for i in range(len(crowd.distance))]].to_numpy().T
    expected = np.hstack([np.asarray(near.rows.obs), np.asarray(near.rows.action)])
    assert shown == pytest.approx(expected)


def test_weights_that_no_learner_made_here_have_no_sum(store: Path) -> None:
    assert isinstance(asked(info(store, PENDULUM_TOM), 200)[1], str)  # before TOM weighs
    assert isinstance(asked(info(store, "pendulum-mle-0"))[1], str)


@pytest.mark.parametrize("row", ["100000", "\u00b2", "1e400", "nan"])
def test_a_row_that_the_buffer_does_not_have_is_dropped(rows: Rows, row: str) -> None:
    app = in_buffer(run=PENDULUM_TOM, step=str(FIT), row=row)
    assert app.number_input(key="row").value is None
    app.button(key="why heaviest").click().run()
    assert app.number_input(key="row").value == int(rows.weight.argmax())


def test_the_numbers_of_a_row_are_those_of_the_map_and_the_table(rows: Rows, store: Path) -> None:
    shown = metrics(in_buffer(run=PENDULUM_TOM, step=str(FIT), row="40"))
    run = info(store, PENDULUM_TOM)
    line = row_table(run, rows, np.array([40])).iloc[0]
    assert shown["its step in its episode"] == str(line["step of the episode"])
    assert line["row"] == rows.first + 40
    assert line["episode"] == table(run, buffer_map.sources(run)[str(FIT)])["episode"][40]
    equal = metrics(in_buffer(run="pendulum-mle-0", step=str(FIT), row="5"))
    assert equal["heavier than"] == "0.0 %"


def test_rollouts_say_whose_policy_plays(rows: Rows, store: Path, tmp_path: Path) -> None:
    shutil.copytree(store / PENDULUM_TOM, tmp_path / PENDULUM_TOM)
    run = info(tmp_path, PENDULUM_TOM)
    by_its_own = why.rollouts(run, rows, 5, FIT)
    assert isinstance(by_its_own, why.Rollouts)
    assert by_its_own.own
    (tmp_path / PENDULUM_TOM / layout.policy(FIT)).unlink()
    by_the_last = why.rollouts(run, rows, 5, FIT)
    assert isinstance(by_the_last, why.Rollouts)
    assert not by_the_last.own
    assert not np.array_equal(by_the_last.paths, by_its_own.paths)
    (tmp_path / PENDULUM_TOM / layout.POLICY).unlink()
    assert isinstance(why.rollouts(run, rows, 5, FIT), str)
