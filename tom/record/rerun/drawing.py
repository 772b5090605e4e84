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
EXPERT = (240, 180, 60)
LEARNT = (80, 160, 250)
TRUE = (90, 200, 120)
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


def places(stream: rr.RecordingStream, points: NDArray) -> None:
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
    match name:
        case "map":
            line = arrays["centre_line"]
            # One strip for each segment, so that round ends make round corners.
            pieces = _up(np.stack([line[:-1], line[1:]], axis=1))
            width = float(arrays["road_half_width"])
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
            for part, drawn in (("edge", edge), ("road", road), ("ends", circles)):
                stream.log(f"{MAP}/{part}", drawn, static=True)
        case "trajectories":
            for of, color in (("expert", EXPERT), ("learnt", LEARNT)):
                strips = [_up(path) for key, path in arrays.items() if key.startswith(f"{of}_")]
                if strips:
                    drawn = rr.LineStrips2D(strips, colors=color, radii=0.002)
                    stream.log(f"{MAP}/{of}", drawn)
        case "model":
            origins = _up(arrays["points"])
            for of, color in (("true", TRUE), ("modelled", MODELLED)):
                arrows = rr.Arrows2D(
                    origins=origins, vectors=_up(arrays[of]), colors=color, radii=0.0015
                )
                stream.log(f"{MAP}/{of}", arrows)


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
