"""A run's story as plain data for a canvas: weights, buffer, returns and robots on one timeline."""

import base64
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from app.data import buffer, readers
from app.data.buffer import WINDOW, poses, windows
from app.data.called import names
from tom.analysis import planes
from tom.analysis.curves import curve_points
from tom.data.transitions import Transitions
from tom.envs import ROAD, Task
from tom.envs import scene as geometry
from tom.envs.scene import Model
from tom.errors import UserError
from tom.record.reader import RunReader
from tom.record.task_record import scene_of, task_of
from tom.spread import spread

MOST = 32_767
"""millimetres; the largest number of 16 bits"""
FITS = 240
"""maximum number of fits: four per second of a minute"""
POINTS = 2500
ROBOTS = 56
EVERY = 2
"""steps from one frame of a moment or an evaluation to the next"""
EPISODES, FRAMES = 12, 150
"""maximum number of shown evaluations, and of frames of each"""


def story(run: RunReader) -> dict[str, Any]:
    """The data of the cinema, ready for JSON. Raises UserError if a part is missing."""
    profiles = readers.profiles(run)
    if len(profiles.env_step) < 2:
        raise UserError("a story needs two model fits at least, and this run has kept fewer")
    recorded, _, state, _ = buffer.recorded(run)
    if run.env == ROAD:
        raise UserError("road-and-rocks has a story of its own: the page Road and rocks plays it")
    if not len(recorded):
        raise UserError("its buffer is not there: no robots and no map of the buffer can be drawn")
    known, model = task_of(run), scene_of(run)
    if model is None:
        raise UserError(f"there is no robot to draw in {run.env}")
    fits = spread(len(profiles.env_step), FITS)
    end = min(int(profiles.env_step[-1]), len(recorded))
    rows = recorded[:end]
    return {
        "title": names([run])[run.run_id],
        "steps": profiles.env_step[fits].tolist(),
        "count": profiles.count[fits].tolist(),
        "ess": np.round(profiles.ess[fits], 4).tolist(),
        "bins": profiles.bins.shape[1],
        "weights": packed(np.log2(np.maximum(profiles.bins[fits], 2.0**-9)).astype(np.float32)),
        "returns": _returns(run),
        "cloud": _cloud(rows),
        "crowd": _crowd(known, model, rows, state),
        "policy": _policy(known, model, readers.reader(run)),
        "dt": model.dt,
    }


def may_be_told(run: RunReader) -> bool:
    """Whether the run has the parts of a story, as far as is known without reading them."""
    return run.env != ROAD and readers.has_profiles(run) and buffer.has_rows(run)


def _returns(run: RunReader) -> dict[str, list[float]]:
    step, value = curve_points(readers.metrics(run), "eval/return")
    return {"step": np.asarray(step).tolist(), "value": np.round(value, 2).tolist()}


def _cloud(rows: Transitions) -> dict[str, Any]:
    """Evenly chosen transitions of the buffer, on its two principal components in [0, 1]."""
    obs, action = (range(np.shape(part)[1]) for part in (rows.obs, rows.action))
    plane = planes.principal_of(rows, ([str(i) for i in obs], [str(i) for i in action]))
    x, y = planes.of_rows(plane, rows).T
    index = spread(len(rows), POINTS)

    def unit(x: NDArray) -> NDArray[np.float32]:
        low, high = np.quantile(x, [0.003, 0.997])
        return np.clip((x[index] - low) / max(high - low, 1e-9), 0, 1).astype(np.float32)

    return {
        "row": packed(index.astype(np.int32)),
        "x": packed(unit(x)),
        "y": packed(unit(y)),
    }


def _crowd(
    known: Task, model: Model, rows: Transitions, state: Mapping[str, NDArray]
) -> dict[str, Any]:
    """Robots in evenly chosen states of the buffer, each moving through its window of steps."""
    index = spread(len(rows), ROBOTS)
    state = {name: of[: len(rows)] for name, of in state.items()}
    qpos = poses(known, rows, state, windows(rows.ended(), index.tolist()))[:, ::EVERY]
    return {
        "row": index.tolist(),
        "frames": qpos.shape[1],
        "now": WINDOW // EVERY,
        "every": EVERY,
        **body(model, qpos.reshape(-1, qpos.shape[-1])),
    }


def _policy(known: Task, model: Model, reader: RunReader) -> list[dict[str, Any]]:
    """Evaluation episodes during the run, which show the progress of the policy."""
    kept = np.array(reader.evaluation_steps(), np.int64)
    told = []
    for step in kept[spread(len(kept), EPISODES)].tolist():
        episodes = [e for e in reader.episodes(step) if e.qpos is not None and e.length]
        if not episodes:
            continue
        returns = [e.undiscounted_return for e in episodes]
        middle = episodes[int(np.argsort(returns)[len(returns) // 2])]
        assert middle.qpos is not None
        about = {"step": step, "return": round(middle.undiscounted_return, 1), "every": EVERY}
        qpos = middle.qpos[: EVERY * FRAMES : EVERY]
        told.append(about | travelling(known, model, qpos))
    return told


def body(model: Model, qpos: NDArray) -> dict[str, Any]:
    """A MuJoCo task's robot at joint positions (H, nq), as JSON; the floor is at height 0.

    G parts have a radius (G,) and ends (H, G, 2, 3); those of a sphere coincide.
    """
    shapes = geometry.geometry(model.mj, qpos)
    capsules, round_ = shapes.capsules, shapes.ellipsoids
    half = capsules.axis * capsules.size[:, 1:2]
    ends = np.stack([capsules.center - half, capsules.center + half], 2)
    ends = np.concatenate([ends, np.repeat(round_.center[:, :, None], 2, 2)], 1)
    radius = np.concatenate([capsules.size[:, 0], round_.size.mean(1)])
    lowest = float((ends[..., 2] - radius[:, None]).min()) if ends.size else 0.0
    ends[..., 2] -= lowest if shapes.floor is None else shapes.floor
    return {
        "radius": _millimetres(radius).tolist(),
        "shape": list(ends.shape[:2]),
        "ends": packed(_millimetres(ends)),
    }


def travelling(known: Task, model: Model, qpos: NDArray) -> dict[str, Any]:
    """A robot over the origin, and how far it is from there in each frame, metres."""
    roots = known.root_dims or 0
    place, standing = qpos[:, 0] * bool(roots), qpos.copy()
    standing[:, :roots] = 0
    return {"place": np.round(place, 3).tolist(), **body(model, standing)}


def packed(numbers: NDArray) -> str:
    """Numbers as base64, little-endian, with their own bit width."""
    little = numbers.astype(numbers.dtype.newbyteorder("<"), copy=False)
    return base64.b64encode(np.ascontiguousarray(little).tobytes()).decode()


def _millimetres(metres: NDArray) -> NDArray[np.int16]:
    return np.clip(np.round(1000 * metres), -MOST, MOST).astype(np.int16)
