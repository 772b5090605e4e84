"""One fit of one road-and-rocks run, read from its folder for the map and the 3D scene."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from app.data.cache import VersionedCache
from app.data.roadmap import RoadShape, road_share, trajectories, weight_grid
from tom.record import stamps
from tom.record.reader import RunReader, at_or_before

MODEL, TRAJECTORIES = "model", "trajectories"
"""recorded fields of every fit"""


@dataclass(frozen=True)
class Picture:
    """The data of one fit."""

    learner: str
    step: int
    road: RoadShape
    grid: NDArray[np.float64]  # (CELLS, CELLS) mean weight, row 0 at the lowest y
    share: float  # of the weight that lies on the road
    expert: list[NDArray]  # (H + 1, 2) each
    learnt: list[NDArray]  # (H + 1, 2) each
    points: NDArray  # (G, 2)
    true: NDArray  # (G, 2) displacements under the expert's action
    modelled: NDArray  # (G, 2)


def steps(run: RunReader) -> list[int]:
    """The fits that can be shown, because their single weights were stored."""
    return run.snapshot_steps() if run.field_steps("map") else []


_PICTURES: VersionedCache[Picture | None] = VersionedCache()


def load(run: RunReader, step: int) -> Picture | None:
    """The fit at `step`; None if the run's folder lacks the map (see `run.problems`)."""
    # A training writes the snapshot first, and these fields a moment later.
    fields = stamps.fields(run.path, step, MODEL, TRAJECTORIES)
    version = stamps.snapshot(run.path, step), fields
    return _PICTURES.get((str(run.path), step), lambda: _read(run, step), version)


def _read(run: RunReader, step: int) -> Picture | None:
    try:
        road = RoadShape.of(run.field("map", at_or_before(run.field_steps("map"), step)))
    except LookupError:
        return None
    weight = run.snapshot(step)["weight"].to_numpy(np.float32)
    obs = np.asarray(run.buffer()[0].obs)[: len(weight)]
    obs, weight = obs.reshape(-1, 2), weight[: len(obs)]
    model = _field(run, MODEL, step)
    lines = _field(run, TRAJECTORIES, step)
    nothing = np.zeros((0, 2), np.float32)
    return Picture(
        learner=run.learner,
        step=step,
        road=road,
        grid=weight_grid(obs, weight),
        share=road_share(obs, weight, road),
        expert=trajectories(lines, "expert"),
        learnt=trajectories(lines, "learnt"),
        points=model.get("points", nothing),
        true=model.get("true", nothing),
        modelled=model.get("modelled", nothing),
    )


def _field(run: RunReader, name: str, step: int) -> dict[str, NDArray]:
    recorded = run.field_steps(name)
    return run.field(name, at_or_before(recorded, step)) if recorded else {}
