"""The map of road-and-rocks in Rerun: road, data, weights, trajectories, displacements, cars."""

from collections.abc import Mapping

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from tom.record.rerun.blueprint import MAP
from tom.record.rerun.robot import GREY, Times

TARMAC = (120, 130, 145)
EXPERT = (240, 180, 60)
LEARNT = (80, 160, 250)
TRUE = (90, 200, 120)
MODELLED = (230, 90, 90)


def places(stream: rr.RecordingStream, points: NDArray) -> None:
    """Draw the positions (N, 2) of the transitions."""
    drawn = rr.Points2D.from_fields(positions=_up(points), radii=0.004, draw_order=-1)
    stream.log(f"{MAP}/data", drawn, static=True)


def weights(stream: rr.RecordingStream, weight: NDArray) -> None:
    """Colour the transitions by their weights (N,)."""
    stream.log(f"{MAP}/data", rr.Points2D.from_fields(colors=heat(weight)))


def car(
    stream: rr.RecordingStream,
    path: str,
    times: Times,
    points: NDArray,
    colour: tuple[int, int, int],
) -> None:
    """Draw a car at `path` that moves through positions (H + 1, 2)."""
    look = rr.Points2D.from_fields(colors=colour, radii=0.012, draw_order=2)
    stream.log(path, look, static=True)
    stream.send_columns(path, times, rr.Points2D.columns(positions=_up(points)))


def picture(stream: rr.RecordingStream, name: str, arrays: Mapping[str, NDArray]) -> None:
    """Draw the task's picture `name`, from the arrays described in docs/run-folder.md."""
    draw = {"map": _map, "trajectories": _trajectories, "model": _model}
    if name in draw:
        draw[name](stream, arrays)


def _map(stream: rr.RecordingStream, arrays: Mapping[str, NDArray]) -> None:
    line = arrays["centre_line"]
    width = float(arrays["road_half_width"])
    # One strip for each segment, so that round ends make round corners.
    pieces = _up(np.stack([line[:-1], line[1:]], axis=1))
    road = rr.LineStrips2D(pieces, radii=width, colors=TARMAC, draw_order=-2)
    ends = np.stack([arrays["start"], arrays["goal"]])
    circles = rr.Ellipses2D(
        centers=_up(ends[:, :2]),
        half_sizes=ends[:, 2:].repeat(2, axis=1),
        colors=[LEARNT, TRUE],
        labels=["start", "goal"],
    )
    corners = np.array([(0, 0), (1, 0), (1, 1), (0, 1), (0, 0)])
    edge = rr.LineStrips2D([_up(corners)], colors=GREY, radii=0.001)
    stream.log(f"{MAP}/edge", edge, static=True)
    stream.log(f"{MAP}/road", road, static=True)
    stream.log(f"{MAP}/ends", circles, static=True)


def _trajectories(stream: rr.RecordingStream, arrays: Mapping[str, NDArray]) -> None:
    for name, color in (("expert", EXPERT), ("learnt", LEARNT)):
        strips = [_up(path) for key, path in arrays.items() if key.startswith(f"{name}_")]
        if strips:
            drawn = rr.LineStrips2D(strips, colors=color, radii=0.002)
            stream.log(f"{MAP}/{name}", drawn)


def _model(stream: rr.RecordingStream, arrays: Mapping[str, NDArray]) -> None:
    for name, color in (("true", TRUE), ("modelled", MODELLED)):
        arrows = rr.Arrows2D(
            origins=_up(arrays["points"]),
            vectors=_up(arrays[name]),
            colors=color,
            radii=0.0015,
        )
        stream.log(f"{MAP}/{name}", arrows)


def heat(weight: NDArray) -> NDArray[np.uint8]:
    """Colours (N, 4) of weights (N,): blue below the mean of 1, grey at it, red above.

    The scale is logarithmic and ends at a tenth and at ten times the mean.
    """
    share = np.log10(np.clip(weight, 0.1, 10.0))[:, None]  # -1 to 1
    low, mean, high = np.array([(50, 90, 200), (170, 170, 170), (220, 60, 40)], float)
    color = np.where(share < 0, mean + share * (mean - low), mean + share * (high - mean))
    alpha = np.full((len(weight), 1), 200.0)
    return np.concatenate([color, alpha], axis=1).astype(np.uint8)


def _up(points: NDArray) -> NDArray:
    """Map points (..., 2) for a view in which y runs downwards."""
    return points * np.array([1.0, -1.0])
