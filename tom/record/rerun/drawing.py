"""Robots, their floor, and the map of road-and-rocks in Rerun."""

from collections.abc import Mapping

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from tom.envs import scene

MAP, GROUND = "map", "scene/ground"
"""where the map of road-and-rocks and the robots' floor are logged"""

Times = tuple[rr.TimeColumn, ...]

GREY = (150, 150, 150)
GHOST = (230, 90, 90)
TARMAC = (120, 130, 145)
LEARNT = (80, 160, 250)
GOAL = (90, 200, 120)
MODELLED = (230, 90, 90)


SHAPES = {
    "capsules": rr.Capsules3D,
    "ellipsoids": rr.Ellipsoids3D,
    "cylinders": rr.Cylinders3D,
    "boxes": rr.Boxes3D,
}


def robot(
    stream: rr.RecordingStream, path: str, times: Times, drawn: scene.Geometry, *, ghost: bool
) -> None:
    """Draw the moving robot at `path`; a ghost is translucent and has one colour."""
    for name, kind in SHAPES.items():
        shape: scene.Shape = getattr(drawn, name)
        frames, count = shape.center.shape[:2]
        if not count:
            continue
        look = {
            "colors": GHOST if ghost else shape.color,
            "fill_mode": "transparentfillmajorwireframe" if ghost else "solid",
        }
        if name in ("capsules", "cylinders"):
            radius, half = shape.size.T
            look |= {"radii": radius, "lengths": 2 * half}
        else:
            look |= {"half_sizes": shape.size}
        moving = {"quaternions": shape.quaternion.reshape(-1, 4)}
        if name == "capsules":
            moving["translations"] = shape.capsule_end.reshape(-1, 3)
        else:
            moving["centers"] = shape.center.reshape(-1, 3)
        columns = kind.columns(**moving).partition([count] * frames)
        stream.log(f"{path}/{name}", kind.from_fields(**look), static=True)
        stream.send_columns(f"{path}/{name}", times, columns)


def floor(stream: rr.RecordingStream, height: float) -> None:
    """Draw the floor as a slab with lines one metre apart, which show the robot's speed.

    It is translucent, because the viewer may be light or dark.
    """
    slab = rr.Boxes3D(
        centers=[(40, 0, height - 0.05)],
        half_sizes=[(60, 10, 0.045)],
        colors=[(128, 134, 144)],
        fill_mode="transparentfillmajorwireframe",
    )
    along = [[(-20, y, height), (100, y, height)] for y in range(-10, 11)]
    across = [[(x, -10, height), (x, 10, height)] for x in range(-20, 101)]
    lines = rr.LineStrips3D(along + across, colors=GREY, radii=0.004)
    stream.log(f"{GROUND}/slab", slab, static=True)
    stream.log(f"{GROUND}/lines", lines, static=True)


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


def road_map(stream: rr.RecordingStream, arrays: Mapping[str, NDArray]) -> None:
    """Draw the map of road-and-rocks, from the arrays described in docs/run-folder.md."""
    line = arrays["centre_line"]
    # One strip for each segment, so that round ends make round corners.
    pieces = _up(np.stack([line[:-1], line[1:]], axis=1))
    width = float(arrays["road_half_width"])
    road = rr.LineStrips2D(pieces, radii=width, colors=TARMAC, draw_order=-2)
    ends = np.stack([arrays["start"], arrays["goal"]])
    circles = rr.Ellipses2D(
        centers=_up(ends[:, :2]),
        half_sizes=ends[:, 2:].repeat(2, axis=1),
        colors=[LEARNT, GOAL],
        labels=["start", "goal"],
    )
    corners = np.array([(0, 0), (1, 0), (1, 1), (0, 1), (0, 0)])
    edge = rr.LineStrips2D([_up(corners)], colors=GREY, radii=0.001)
    for part, drawn in (("edge", edge), ("road", road), ("ends", circles)):
        stream.log(f"{MAP}/{part}", drawn, static=True)


def _up(points: NDArray) -> NDArray:
    """Map points (..., 2) for a view in which y runs downwards."""
    return points * np.array([1.0, -1.0])
