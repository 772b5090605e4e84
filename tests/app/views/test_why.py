"""Why this weight: the page's sum is the weight that is recorded."""

import os
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from studio_pages import Show, array, draw, figures, in_buffer, metrics, trace
from studio_runs import PENDULUM_TOM, ROAD_TOM, info

from app.data import buffer, buffer_map, why
from app.data.buffer import Rows
from app.views.attention.in_buffer import listed
from tom.analysis import why as reasons
from tom.cli import main
from tom.record import Store, layout
from tom.record.export import export_small
from tom.record.reader import RunReader
from tom.training.presets import resolve
from tom.training.run import train

FIT = 300


@pytest.fixture
def weighed(store: Path, tmp_path: Path, show: Show) -> Path:
    """A store with a weighing of the pendulum at a fit whose policy was kept."""
    there = tmp_path / "store"
    shutil.copytree(store, there, copy_function=os.link)
    step = RunReader(there / PENDULUM_TOM).policy_steps()[-1]
    words = [
        "weigh", PENDULUM_TOM, "--policy", PENDULUM_TOM, "--step", str(step), "--learner", "tom",
        "--seeds", "0", "--footprint", "100", "--store", str(there), "--matmul", "default",
    ]  # fmt: skip
    assert main(words) == 0
    show(there)
    return there


def of_fit(run: RunReader, fit: int = FIT) -> tuple[Rows, why.Why | str]:
    """The rows of a fit, and why they have their weights."""
    source = buffer_map.sources(run)[str(fit)]
    rows = buffer_map.rows(run, source)
    assert rows is not None
    return rows, why.why_of(run, rows, source)


def own_rows(store: Path) -> Rows:
    found = buffer.rows(info(store, PENDULUM_TOM), FIT)
    assert found is not None
    return found


def test_a_kept_fit_has_the_terms_of_its_weights(store: Path) -> None:
    rows, found = of_fit(info(store, PENDULUM_TOM))
    assert isinstance(found, why.Why)
    assert len(found.policy_rows) == 100  # 200 steps of exploration came before
    for row in range(0, FIT, 17):
        assert found.sum_of(row).weight == pytest.approx(rows.weight[row], abs=1e-5)


def test_a_weighing_has_the_terms_of_its_weights(weighed: Path) -> None:
    run = info(weighed, PENDULUM_TOM)
    (source,) = buffer_map.others(run).values()
    rows = buffer_map.rows(run, source)
    assert rows is not None
    found = why.why_of(run, rows, source)
    assert isinstance(found, why.Why)
    for row in range(0, len(rows), 17):
        assert found.sum_of(row).weight == pytest.approx(source.weight[row], abs=1e-5)
    assert len(found.policy_rows) == 100
    near = why.neighbours(rows, found, 5)
    assert (near.near.distance.diff() >= 0).all()


def test_a_fits_own_rows_are_not_compared_with_themselves(store: Path) -> None:
    rows, found = of_fit(info(store, PENDULUM_TOM))
    assert isinstance(found, why.Why)
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
        assert isinstance(found, why.Why)
        for row in range(0, len(rows), 17):
            assert found.sum_of(row).weight == pytest.approx(rows.weight[row], rel=0.01, abs=0.01)


def test_the_roads_policy_rows_are_its_footprint(store: Path) -> None:
    run = info(store, ROAD_TOM)
    rows, found = of_fit(run, 60)
    assert isinstance(found, why.Why)
    shown = RunReader(store / ROAD_TOM).field("data", 0)["footprint"]
    assert 0 < shown.sum() < 100
    np.testing.assert_array_equal(found.policy_rows.obs.numpy(), np.asarray(rows.rows.obs)[shown])


def test_what_was_recorded_after_a_row_ends_with_its_episode(store: Path) -> None:
    rows = own_rows(store)
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
        rows = buffer.rows(run, 300)
        assert rows is not None
        row = int(rows.weight.argmax())
        assert rows.weight[row] > 1.1
        # VaGram's weights scale the loss, so its rollouts start anywhere.
        share = 0.0 if learner == "vagram" else 0.5
        expected = 1000 / 300 * (1 + share * (rows.weight[row] - 1))
        assert why.starts(run, rows, row) == pytest.approx((expected, 1000 / 300), rel=1e-4)


@pytest.mark.usefixtures("studio")
def test_the_page_says_why(store: Path) -> None:
    rows = own_rows(store)
    row = int(rows.weight.argmax())
    app = draw("attention", run=PENDULUM_TOM, step=str(FIT), row=str(row))
    bars = next(f for f in figures(app) if f["data"][0]["type"] == "waterfall")
    values = array(trace(bars, type="waterfall")["y"])
    assert values[-1] == pytest.approx(rows.weight[row], abs=1e-5)
    assert any("start in this state" in c.value for c in app.caption)
    assert any("standard deviations over" in c.value for c in app.caption)


@pytest.mark.usefixtures("studio")
def test_every_neighbour_has_a_column_however_near_to_the_next(store: Path) -> None:
    rows, found = of_fit(info(store, PENDULUM_TOM))
    assert isinstance(found, why.Why)
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
    assert isinstance(of_fit(info(store, PENDULUM_TOM), 200)[1], str)  # before TOM weighs
    assert isinstance(of_fit(info(store, "pendulum-mle-0"))[1], str)


@pytest.mark.usefixtures("studio")
@pytest.mark.parametrize("row", ["100000", "\u00b2", "1e400", "nan"])
def test_a_row_that_the_buffer_does_not_have_is_dropped(store: Path, row: str) -> None:
    app = in_buffer(run=PENDULUM_TOM, step=str(FIT), row=row)
    assert app.number_input(key="row").value is None
    app.button(key="why heaviest").click().run()
    assert app.number_input(key="row").value == int(own_rows(store).weight.argmax())


@pytest.mark.usefixtures("studio")
def test_the_numbers_of_a_row_are_those_of_the_map_and_the_table(store: Path) -> None:
    rows = own_rows(store)
    shown = metrics(in_buffer(run=PENDULUM_TOM, step=str(FIT), row="40"))
    line = listed(info(store, PENDULUM_TOM), rows, np.array([40])).iloc[0]
    assert shown["its step in its episode"] == str(line["step of the episode"])
    assert (line["row"], line["episode"]) == (rows.first + 40, rows.episode[40] + 1)
    equal = metrics(in_buffer(run="pendulum-mle-0", step=str(FIT), row="5"))
    assert equal["heavier than"] == "0.0 %"


@pytest.mark.usefixtures("studio")
def test_rollouts_say_whose_policy_plays(store: Path, tmp_path: Path) -> None:
    shutil.copytree(store / PENDULUM_TOM, tmp_path / PENDULUM_TOM)
    run, rows = info(tmp_path, PENDULUM_TOM), own_rows(store)
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
