"""Attention in the buffer: the map, the selection and what it chooses are the recorded rows."""

import shutil
from dataclasses import replace
from pathlib import Path
from queue import SimpleQueue
from threading import Thread

import numpy as np
import pytest
from kernel import wait_for
from numpy.typing import NDArray
from streamlit.testing.v1 import AppTest
from studio_pages import Show, answers, in_buffer, map_of
from studio_runs import PENDULUM_TOM, info

from app.data import buffer, buffer_map, cache, columns
from app.data.buffer import WINDOW, Rows, poses, windows
from app.data.columns import Column
from app.data.selection import Selection, between, inside
from app.parts import timeline
from app.scenes import control, solids
from app.views.attention.in_buffer import table
from tom.envs import scene, task
from tom.record.reader import RunReader

pytestmark = pytest.mark.usefixtures("studio")
FIT = 300


@pytest.fixture
def rows(store: Path) -> Rows:
    found = buffer.rows(info(store, PENDULUM_TOM), FIT)
    assert found is not None
    return found


def test_the_robots_are_those_of_the_timelines_fit(store: Path, tmp_path: Path, show: Show) -> None:
    told: SimpleQueue[control.Selection] = SimpleQueue()
    socket = str(tmp_path / "control")
    heard = socket, lambda _, selection: told.put(selection), lambda _: None
    Thread(target=control.listen, args=heard, daemon=True).start()
    wait_for(lambda: answers(socket))
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
    robots = solids.of(scene.model("inverted-pendulum"), found)
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
    mask = buffer_map.chosen(run, source, Selection.of(where, [outline]))
    return (source.first + np.flatnonzero(mask)).tolist()


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


def test_the_browser_gets_each_array_of_the_buffer(rows: Rows, store: Path) -> None:
    given = map_of(in_buffer(run=PENDULUM_TOM, step=str(FIT)))

    def array(url: str) -> NDArray[np.uint16]:
        content = cache.array(url.rpartition("/")[2])
        assert content is not None
        return np.frombuffer(content, np.uint16)

    [source] = [one for one in given["sources"] if one["step"] == FIT]
    assert (source["first"], source["count"]) == (rows.first, FIT)
    assert array(source["url"]).tolist() == columns.weight_codes(rows.weight).tolist()
    recorded = RunReader(store / PENDULUM_TOM).buffer()[0]
    [angle] = [one for one in given["columns"] if one["name"] == "pole angle"]
    back = columns.decode(array(angle["url"]), Column("", angle["low"], angle["high"]))
    known = np.asarray(recorded.obs)[:, 1].clip(angle["low"], angle["high"])
    assert back == pytest.approx(known, abs=1e-3)
    last = max(one["step"] for one in given["sources"])
    assert given["planes"][0]["key"] == f"contrast@{last}"
    assert cache.array("0" * 32) is None


def test_map_and_file_have_one_policy_distance_that_of_the_fits_own_policy(store: Path) -> None:
    run = info(store, PENDULUM_TOM)
    given = {one["step"]: one for one in map_of(in_buffer(run=PENDULUM_TOM))["sources"]}
    distances = []
    for fit in RunReader(store / PENDULUM_TOM).policy_steps():
        content = cache.array(given[fit]["distance"].rpartition("/")[2])
        assert content is not None
        far = columns.decode(np.frombuffer(content, np.uint16), columns.DISTANCE)
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
    place = buffer_map.placed(info(store, PENDULUM_TOM), plane["key"])
    assert place is not None
    assert np.ptp(place.xy, axis=0).min() > 0
    x, y = place.xy.T - place.xy.mean(0)[:, None]
    assert abs(x @ y) < 1e-3 * np.sqrt((x @ x) * (y @ y))  # as of principal components


def test_a_buffer_that_was_read_ahead_is_not_read_again(
    store: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    buffer_map.read_ahead(info(store, PENDULUM_TOM))
    monkeypatch.setattr(RunReader, "recorded", lambda *_, **__: pytest.fail("read again"))
    assert map_of(in_buffer(run=PENDULUM_TOM))["planes"]


def test_a_buffer_that_cannot_be_read_is_not_read_ahead(store: Path, tmp_path: Path) -> None:
    copy = shutil.copytree(store / PENDULUM_TOM, tmp_path / PENDULUM_TOM)
    *others, _ = sorted((copy / "buffer").glob("*.npz"))  # its length is that of the last
    for segment in others:
        segment.write_bytes(b"torn")
    buffer_map.read_ahead(RunReader(copy))


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
