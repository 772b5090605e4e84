"""A robot and its floor in Rerun."""

from typing import Any

import rerun as rr
from numpy.typing import NDArray

from tom.envs import scene
from tom.record.rerun.blueprint import GROUND

GREY = (150, 150, 150)
GHOST = (230, 90, 90)

Times = tuple[rr.TimeColumn, ...]
Solids = tuple[rr.AsComponents, rr.ComponentColumnList]
"""what stays the same over time, and the places and rotations over time"""


def draw(
    stream: rr.RecordingStream, path: str, times: Times, drawn: scene.Geometry, *, ghost: bool
) -> None:
    """Draw the moving robot at `path`; a ghost is translucent and has one colour."""
    for name, shape, solids in (
        ("capsules", drawn.capsules, _capsules),
        ("ellipsoids", drawn.ellipsoids, _ellipsoids),
        ("cylinders", drawn.cylinders, _cylinders),
        ("boxes", drawn.boxes, _boxes),
    ):
        frames, count = shape.center.shape[:2]
        if count:
            look = {
                "colors": GHOST if ghost else shape.color,
                "fill_mode": "transparentfillmajorwireframe" if ghost else "solid",
            }
            fixed, moving = solids(shape, look)
            stream.log(f"{path}/{name}", fixed, static=True)
            stream.send_columns(f"{path}/{name}", times, moving.partition([count] * frames))


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


def _capsules(shape: scene.Shape, look: dict[str, Any]) -> Solids:
    radius, half = shape.size.T
    fixed = rr.Capsules3D.from_fields(radii=radius, lengths=2 * half, **look)
    ends = shape.capsule_end.reshape(-1, 3)
    return fixed, rr.Capsules3D.columns(translations=ends, quaternions=_turns(shape))


def _ellipsoids(shape: scene.Shape, look: dict[str, Any]) -> Solids:
    fixed = rr.Ellipsoids3D.from_fields(half_sizes=shape.size, **look)
    return fixed, rr.Ellipsoids3D.columns(centers=_centers(shape), quaternions=_turns(shape))


def _cylinders(shape: scene.Shape, look: dict[str, Any]) -> Solids:
    radius, half = shape.size.T
    fixed = rr.Cylinders3D.from_fields(radii=radius, lengths=2 * half, **look)
    return fixed, rr.Cylinders3D.columns(centers=_centers(shape), quaternions=_turns(shape))


def _boxes(shape: scene.Shape, look: dict[str, Any]) -> Solids:
    fixed = rr.Boxes3D.from_fields(half_sizes=shape.size, **look)
    return fixed, rr.Boxes3D.columns(centers=_centers(shape), quaternions=_turns(shape))


def _centers(shape: scene.Shape) -> NDArray:
    """The centre of every solid in every frame, (H G, 3)."""
    return shape.center.reshape(-1, 3)


def _turns(shape: scene.Shape) -> NDArray:
    """The rotation of every solid in every frame, (H G, 4)."""
    return shape.quaternion.reshape(-1, 4)
