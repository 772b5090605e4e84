"""Films of a run as HTML files whose Content-Security-Policy forbids any request.

The cinema tells a run's story on one timeline: weights, buffer, returns and robots. Another film
has an episode between two predictions. Both are plain data for a canvas.
"""

import base64
import html
import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from app.data import buffer, readers
from app.data.buffer import WINDOW, poses, windows
from app.data.run_names import full_names
from app.figures.base import OCTAVES
from app.theme import (
    BACKGROUND,
    BORDER,
    COLUMNS,
    DIVERGING,
    REAL,
    SURFACE,
    TEXT,
    Mode,
    learner_colour,
)
from tom.analysis import planes
from tom.analysis.curves import curve_points
from tom.analysis.weight_readers import has_profiles
from tom.data.transitions import Transitions
from tom.envs import ROAD, Task
from tom.envs import scene as geometry
from tom.envs.scene import Model
from tom.errors import UserError
from tom.record.reader import RunReader
from tom.record.task_record import scene_of, task_of
from tom.spread import spread

SECONDS = 60.0
WIDTH, HEIGHT = 1280, 720
SPEED = 0.25
GHOST_DISTANCE = 0.75
"""metres between two robots"""
UNCHANGED = "x1"
FITS = 240
"""maximum number of fits: four per second of a minute"""
POINTS, ROBOTS = 2500, 56
"""of the buffer"""
EVERY = 2
"""steps from one frame of a moment or an evaluation to the next"""
EPISODES, FRAMES = 12, 150
"""maximum number of shown evaluations, and of frames of each"""
MAX_MILLIMETRES = 32_767
"""millimetres; the largest number of 16 bits"""
_CONTENT_POLICY = "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'"
"""the Content-Security-Policy: no external resources"""


def story(run: RunReader) -> dict[str, Any]:
    """The data of the cinema, ready for JSON. Raises UserError if a part is missing."""
    profiles = readers.profiles(run)
    if len(profiles.env_step) < 2:
        raise UserError("a story needs at least two model fits, and this run has kept fewer")
    recorded, _, state, _ = buffer.recorded_with_states(run)
    if not len(recorded):
        raise UserError(
            "its buffer is missing, so neither robots nor the buffer's map can be drawn"
        )
    task, model = task_of(run), scene_of(run)
    if model is None:
        raise UserError(f"there is no robot to draw in {run.env}")
    fits = spread(len(profiles.env_step), FITS)
    rows = recorded[: int(profiles.rows[-1])]
    step, value = curve_points(readers.metrics(run), "eval/return")
    return {
        "title": full_names([run])[run.run_id],
        "steps": profiles.env_step[fits].tolist(),
        "rows": profiles.rows[fits].tolist(),
        "count": profiles.count[fits].tolist(),
        "ess": np.round(profiles.ess[fits], 4).tolist(),
        "bins": profiles.bins.shape[1],
        "weights": base64_numbers(
            np.log2(np.maximum(profiles.bins[fits], 2.0**-9)).astype(np.float32)
        ),
        "returns": {"step": np.asarray(step).tolist(), "value": np.round(value, 2).tolist()},
        "cloud": _cloud(rows),
        "crowd": _crowd(task, model, rows, state),
        "policy": _policy(task, model, readers.fresh_reader(run)),
        "dt": model.dt,
    }


def has_story(run: RunReader) -> bool:
    """Whether the run has the parts of a story, as far as is known without reading them."""
    return run.env != ROAD and has_profiles(run) and buffer.has_rows(run)


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
        "row": base64_numbers(index.astype(np.int32)),
        "x": base64_numbers(unit(x)),
        "y": base64_numbers(unit(y)),
    }


def _crowd(
    task: Task, model: Model, rows: Transitions, state: dict[str, NDArray]
) -> dict[str, Any]:
    """Robots in evenly chosen states of the buffer, each moving through its window of steps."""
    index = spread(len(rows), ROBOTS)
    state = {name: of[: len(rows)] for name, of in state.items()}
    qpos = poses(task, rows, state, windows(rows.ended(), index.tolist()))[:, ::EVERY]
    return {
        "row": index.tolist(),
        "frames": qpos.shape[1],
        "now": WINDOW // EVERY,
        "every": EVERY,
        **robot_shapes(model, qpos.reshape(-1, qpos.shape[-1])),
    }


def _policy(task: Task, model: Model, reader: RunReader) -> list[dict[str, Any]]:
    """Evaluation episodes during the run, which show the progress of the policy."""
    kept = np.array(reader.evaluation_steps(), np.int64)
    shown = []
    for step in kept[spread(len(kept), EPISODES)].tolist():
        episodes = [e for e in reader.episodes(step) if e.qpos is not None and e.length]
        if not episodes:
            continue
        returns = [e.undiscounted_return for e in episodes]
        middle = episodes[int(np.argsort(returns)[len(returns) // 2])]
        assert middle.qpos is not None
        about = {"step": step, "return": round(middle.undiscounted_return, 1), "every": EVERY}
        qpos = middle.qpos[: EVERY * FRAMES : EVERY]
        shown.append(about | moving_robot(task, model, qpos))
    return shown


def robot_shapes(model: Model, qpos: NDArray) -> dict[str, Any]:
    """A MuJoCo task's robot at joint positions (H, nq), as JSON; the floor is at height 0.

    Its G parts are drawn as thick lines: a radius (G,) and ends (H, G, 2, 3), in a ball's centre.
    """
    shapes = geometry.geometry(model.mj, qpos)
    (radius, half), (tube, tall) = shapes.capsules.size.T, shapes.cylinders.size.T
    balls, boxes = shapes.ellipsoids.size.mean(1), np.sort(shapes.boxes.size, 1)
    thick = boxes[:, :2].mean(1)
    radius = np.concatenate([radius, balls, tube, thick])
    half = np.concatenate([half, 0 * balls, np.maximum(tall - tube, 0), boxes[:, 2] - thick])
    center, axis = (
        np.concatenate([getattr(shape, name) for shape in shapes.shapes], 1)[:, :, None]
        for name in ("center", "axis")
    )
    ends = center + axis * half[:, None, None] * np.array([[-1], [1]])
    lowest = float((ends[..., 2] - radius[:, None]).min()) if ends.size else 0.0
    ends[..., 2] -= lowest if shapes.floor is None else shapes.floor
    return {
        "radius": _millimetres(radius).tolist(),
        "shape": list(ends.shape[:2]),
        "ends": base64_numbers(_millimetres(ends)),
    }


def moving_robot(task: Task, model: Model, qpos: NDArray) -> dict[str, Any]:
    """A robot over the origin, and how far it is from there in each frame, metres."""
    roots = task.root_dims or 0
    place, standing = qpos[:, 0] * bool(roots), qpos.copy()
    standing[:, :roots] = 0
    return {"place": np.round(place, 3).tolist(), **robot_shapes(model, standing)}


def base64_numbers(numbers: NDArray) -> str:
    """Numbers as base64, little-endian, with their own bit width."""
    little = numbers.astype(numbers.dtype.newbyteorder("<"), copy=False)
    return base64.b64encode(np.ascontiguousarray(little).tobytes()).decode()


def _millimetres(metres: NDArray) -> NDArray[np.int16]:
    return np.clip(np.round(1000 * metres), -MAX_MILLIMETRES, MAX_MILLIMETRES).astype(np.int16)


def cinema(story: dict[str, Any], learner: str, mode: Mode, seconds: float = SECONDS) -> str:
    """The page that plays a story (of `story`) in `seconds`."""
    return document(story["title"], "cinema.js", {**story, "seconds": seconds}, learner, mode)


def document(title: str, script: str, data: dict[str, Any], learner: str, mode: Mode) -> str:
    """One self-contained HTML page: the canvas, its controls, the scripts and their data."""
    colours = {
        "background": BACKGROUND[mode],
        "surface": SURFACE[mode],
        "text": TEXT[mode],
        "border": BORDER[mode],
        "learner": learner_colour(learner),
        "map": DIVERGING[mode],
        "points": COLUMNS[mode],
        "octaves": OCTAVES,
    }
    data = {**data, "mode": mode, "look": colours}
    style, *scripts = (
        Path(__file__).with_name(name).read_text()
        for name in ("film.css", "canvas.js", "mp4.js", script)
    )
    # Escape characters that would end a script element or begin a comment in it.
    json_text = json.dumps(data, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    return (
        f'<!doctype html><html lang="en" data-mode="{mode}"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{_CONTENT_POLICY}">'
        '<meta name="viewport" content="width=device-width">'
        f"<title>{html.escape(title)}</title><style>{style}</style></head><body>"
        f'<canvas width="{WIDTH}" height="{HEIGHT}" role="img" '
        f'aria-label="{html.escape(title)}"></canvas>'
        '<div class="controls"><button type="button" aria-label="play or pause">▶</button>'
        '<input type="range" min="0" max="1" step="any" value="0" aria-label="time">'
        '<button type="button" class="save" hidden title="save the film as MP4">MP4</button></div>'
        "<script>" + "\n".join((f"const TOLD = {json_text};", *scripts)) + "</script></body></html>"
    )


def ghost_film(
    robot: tuple[Task, Model],
    arrays: dict[str, NDArray],
    factor: float,
    name: str,
    learner: str,
    mode: Mode,
) -> str:
    """The page that plays the real robot in the middle and the two ghosts beside it.

    `robot` is the task and its robot's model, `arrays` are those of `ghosts.npz`, and `name` is
    that of the model brushed by `factor`.
    """
    robots = [
        {"name": label, "colour": colour, "shift": shift, "alpha": alpha}
        | moving_robot(*robot, arrays[which])
        for which, label, colour, shift, alpha in (
            ("real", "real", REAL[mode], 0.0, 1.0),
            (UNCHANGED, "unchanged", COLUMNS[mode][0][1], -GHOST_DISTANCE, 0.8),
            (f"x{factor:g}", name, COLUMNS[mode][2][1], GHOST_DISTANCE, 0.8),
        )
    ]
    film = {"robots": robots, "speed": SPEED, "dt": float(arrays["dt"])}
    return document(f"Two ghosts: unchanged weights, and {name}", "ghosts.js", film, learner, mode)
