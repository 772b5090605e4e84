"""A robot and its floor in Rerun."""

import rerun as rr

from tom.envs import scene
from tom.record.rerun.blueprint import GROUND

GREY = (150, 150, 150)
GHOST = (230, 90, 90)

Times = tuple[rr.TimeColumn, ...]


def draw(
    stream: rr.RecordingStream, path: str, times: Times, drawn: scene.Geometry, *, ghost: bool
) -> None:
    """Draw the moving robot at `path`; a ghost is translucent and has one colour."""
    _capsules(stream, f"{path}/capsules", times, drawn.capsules, ghost=ghost)
    _ellipsoids(stream, f"{path}/ellipsoids", times, drawn.ellipsoids, ghost=ghost)
    _cylinders(stream, f"{path}/cylinders", times, drawn.cylinders, ghost=ghost)
    _boxes(stream, f"{path}/boxes", times, drawn.boxes, ghost=ghost)


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


def _capsules(
    stream: rr.RecordingStream, path: str, times: Times, shape: scene.Shape, *, ghost: bool
) -> None:
    frames, count = shape.center.shape[:2]
    if not count:
        return
    radius, half = shape.size.T
    fixed = rr.Capsules3D.from_fields(
        radii=radius,
        lengths=2 * half,
        colors=GHOST if ghost else shape.color,
        fill_mode="transparentfillmajorwireframe" if ghost else "solid",
    )
    stream.log(path, fixed, static=True)
    columns = rr.Capsules3D.columns(
        translations=shape.capsule_end.reshape(-1, 3),
        quaternions=shape.quaternion.reshape(-1, 4),
    )
    stream.send_columns(path, times, columns.partition([count] * frames))


def _ellipsoids(
    stream: rr.RecordingStream, path: str, times: Times, shape: scene.Shape, *, ghost: bool
) -> None:
    frames, count = shape.center.shape[:2]
    if not count:
        return
    fixed = rr.Ellipsoids3D.from_fields(
        half_sizes=shape.size,
        colors=GHOST if ghost else shape.color,
        fill_mode="transparentfillmajorwireframe" if ghost else "solid",
    )
    stream.log(path, fixed, static=True)
    columns = rr.Ellipsoids3D.columns(
        centers=shape.center.reshape(-1, 3), quaternions=shape.quaternion.reshape(-1, 4)
    )
    stream.send_columns(path, times, columns.partition([count] * frames))


def _cylinders(
    stream: rr.RecordingStream, path: str, times: Times, shape: scene.Shape, *, ghost: bool
) -> None:
    frames, count = shape.center.shape[:2]
    if not count:
        return
    radius, half = shape.size.T
    fixed = rr.Cylinders3D.from_fields(
        radii=radius,
        lengths=2 * half,
        colors=GHOST if ghost else shape.color,
        fill_mode="transparentfillmajorwireframe" if ghost else "solid",
    )
    stream.log(path, fixed, static=True)
    columns = rr.Cylinders3D.columns(
        centers=shape.center.reshape(-1, 3), quaternions=shape.quaternion.reshape(-1, 4)
    )
    stream.send_columns(path, times, columns.partition([count] * frames))


def _boxes(
    stream: rr.RecordingStream, path: str, times: Times, shape: scene.Shape, *, ghost: bool
) -> None:
    frames, count = shape.center.shape[:2]
    if not count:
        return
    fixed = rr.Boxes3D.from_fields(
        half_sizes=shape.size,
        colors=GHOST if ghost else shape.color,
        fill_mode="transparentfillmajorwireframe" if ghost else "solid",
    )
    stream.log(path, fixed, static=True)
    columns = rr.Boxes3D.columns(
        centers=shape.center.reshape(-1, 3), quaternions=shape.quaternion.reshape(-1, 4)
    )
    stream.send_columns(path, times, columns.partition([count] * frames))
