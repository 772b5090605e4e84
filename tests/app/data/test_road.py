"""The map's geometry, held against the task itself and what runs recorded."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from common import present
from studio_runs import ROAD_TOM

from app.data import road
from app.data.road import (
    CELLS,
    RoadShape,
    distance_to_road,
    on_road,
    outline,
    weight_grid,
)
from tom.record import layout
from tom.record.reader import RunReader
from tom.road import task
from tom.road.measure import map_field


@pytest.fixture(scope="module")
def road_map() -> RoadShape:
    return RoadShape.of(map_field(task.draw_map(180, 90, torch.Generator().manual_seed(0))))


def test_the_road_is_the_tasks(road_map: RoadShape) -> None:
    points = np.random.default_rng(0).random((5000, 2)).astype(np.float32)
    mine = on_road(points, road_map)
    assert np.array_equal(mine, task.on_road(torch.from_numpy(points)).numpy())
    assert mine.mean() == pytest.approx(0.30, abs=0.02)


def test_the_outline_is_the_roads_edge(road_map: RoadShape) -> None:
    edge = outline(road_map)
    distance = distance_to_road(edge, road_map.centre_line)
    assert distance == pytest.approx(road_map.half_width, abs=1e-6)
    assert np.array_equal(edge[0], edge[-1])
    x, y = edge.T
    area = 0.5 * abs((x[:-1] * y[1:] - x[1:] * y[:-1]).sum())
    # Two rectangles that share a square's corner, a round corner and two round ends.
    h = road_map.half_width
    assert area == pytest.approx(2 * 0.78 * 2 * h - h**2 + (1.25 * np.pi) * h**2, rel=0.01)


def test_cells_hold_the_mean_of_their_transitions() -> None:
    draw = np.random.default_rng(0)
    obs, weight = draw.random((5000, 2)), draw.random(5000)
    row, column = 2, 5
    inside = ((obs * CELLS).astype(int) == [column, row]).all(1)
    assert inside.any()
    mean = weight_grid(obs, weight)
    assert mean[row, column] == pytest.approx(weight[inside].mean())


def test_a_picture_says_what_the_run_recorded(store: Path) -> None:
    run = RunReader(store / ROAD_TOM)
    picture = present(road.picture(run, road.steps(run)[-1]))
    obs = np.asarray(run.buffer()[0].obs)
    weight = run.snapshot(picture.step)["weight"].to_numpy()
    assert np.array_equal(picture.grid, weight_grid(obs, weight), equal_nan=True)
    driven = run.field("trajectories", picture.step)
    for kind, lines in (("expert", picture.expert), ("learnt", picture.learnt)):
        assert all(np.array_equal(line, driven[f"{kind}_{i}"]) for i, line in enumerate(lines))
    assert (len(picture.expert), len(picture.learnt)) == (10, 5)
    assert picture.true.shape == picture.modelled.shape == picture.points.shape == (441, 2)


def test_a_picture_that_was_read_while_its_fit_was_written_is_read_again(
    store: Path, tmp_path: Path
) -> None:
    run = RunReader(shutil.copytree(store / ROAD_TOM, tmp_path / ROAD_TOM))
    before, step = road.steps(run)[-2:]
    fields = {name: run.field(name, step) for name in ("model", "trajectories")}
    for name in fields:
        (run.path / layout.field(name, step)).unlink()
    early = present(road.picture(run, step))
    assert np.array_equal(early.modelled, run.field("model", before)["modelled"])
    for name, arrays in fields.items():
        moved = {key: array + 1 for key, array in arrays.items()}
        np.savez(run.path / layout.field(name, step), allow_pickle=False, **moved)
        road.picture(run, step)
    late = present(road.picture(run, step))
    assert np.array_equal(late.modelled, fields["model"]["modelled"] + 1)
    assert np.array_equal(late.learnt[0], fields["trajectories"]["learnt_0"] + 1)
