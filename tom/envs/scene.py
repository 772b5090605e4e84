"""A MuJoCo task's geometry at recorded joint positions, without rendering.

The geometry is arrays of capsules, ellipsoids, cylinders and boxes, and a floor, for any viewer.
Geoms of other kinds (meshes) are not drawn.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from tom.envs import Task, task
from tom.envs.simulator import simulated

_mj: Any = mujoco  # it ships no types

CAPSULE = int(_mj.mjtGeom.mjGEOM_CAPSULE)
SPHERE = int(_mj.mjtGeom.mjGEOM_SPHERE)
ELLIPSOID = int(_mj.mjtGeom.mjGEOM_ELLIPSOID)
CYLINDER = int(_mj.mjtGeom.mjGEOM_CYLINDER)
BOX = int(_mj.mjtGeom.mjGEOM_BOX)
DRAWN = (CAPSULE, SPHERE, ELLIPSOID, CYLINDER, BOX)
PLANE = int(_mj.mjtGeom.mjGEOM_PLANE)

MjModel = Any
Floats = NDArray[np.float32]


@dataclass(frozen=True)
class Shape:
    """G solids of one kind over H frames; lengths in metres, colours in [0, 1]."""

    size: Floats  # capsules, cylinders (G, 2): radius, half length; others (G, 3): half sizes
    color: Floats  # (G, 4)
    center: Floats  # (H, G, 3)
    axis: Floats  # (H, G, 3) the geom's z axis
    quaternion: Floats  # (H, G, 4) x, y, z, w

    @property
    def capsule_end(self) -> Floats:
        """The centre of each capsule's lower end cap, (H, G, 3)."""
        return (self.center - self.axis * self.size[:, 1:2]).astype(np.float32)


@dataclass(frozen=True)
class Geometry:
    """All shapes in H frames."""

    capsules: Shape
    ellipsoids: Shape
    cylinders: Shape
    boxes: Shape
    root: Floats  # (H, 3) the first moving body
    floor: float | None  # height of the floor

    @property
    def shapes(self) -> tuple[Shape, ...]:
        """The shapes of every kind."""
        return self.capsules, self.ellipsoids, self.cylinders, self.boxes

    @property
    def ground(self) -> float:
        """The floor's height; half a metre below everything if there is no floor."""
        if self.floor is not None:
            return self.floor
        heights = [shape.center[..., 2].min() for shape in self.shapes if shape.center.size]
        return float(min(heights, default=0.5)) - 0.5


@dataclass(frozen=True)
class Model:
    """A task's compiled model and the seconds between two of its steps."""

    mj: MjModel
    dt: float


@cache
def model(env: str) -> Model:
    """The model of a MuJoCo task. Raises UserError for an unknown task."""
    made = made_model(task(env))
    assert made is not None, f"{env} is a MuJoCo task"
    return made


def made_model(known: Task) -> Model | None:
    """The model of a task, which is made for this; None for a task without MuJoCo."""
    made = known.make()
    inside = simulated(made)
    result = None if inside is None else Model(inside.model, inside.dt)
    made.close()
    return result


def geometry(mj: MjModel, qpos: NDArray) -> Geometry:
    """The geometry at joint positions (H, nq)."""
    data = _mj.MjData(mj)
    frames = len(qpos)
    center = np.empty((frames, mj.ngeom, 3), np.float32)
    matrix = np.empty((frames, mj.ngeom, 9), np.float32)
    body = np.empty((frames, mj.nbody, 4))
    root = np.empty((frames, 3), np.float32)
    for i, position in enumerate(np.asarray(qpos, np.float64)):
        data.qpos[:] = position
        _mj.mj_kinematics(mj, data)
        center[i], matrix[i] = data.geom_xpos, data.geom_xmat
        body[i], root[i] = data.xquat, data.xpos[min(1, mj.nbody - 1)]
    quaternion = _product(body[:, mj.geom_bodyid], mj.geom_quat)[..., [1, 2, 3, 0]]
    axis = matrix[..., 2::3]

    def shape(kinds: tuple[int, ...], size: NDArray) -> Shape:
        chosen = np.flatnonzero(np.isin(mj.geom_type, kinds) & (mj.geom_rgba[:, 3] > 0))
        return Shape(
            size[chosen].astype(np.float32),
            mj.geom_rgba[chosen].astype(np.float32),
            center[:, chosen],
            axis[:, chosen],
            quaternion[:, chosen].astype(np.float32),
        )

    return Geometry(
        shape((CAPSULE,), mj.geom_size[:, :2]),
        shape((SPHERE, ELLIPSOID), _half_sizes(mj)),
        shape((CYLINDER,), mj.geom_size[:, :2]),
        shape((BOX,), mj.geom_size),
        root,
        _floor(mj),
    )


def _half_sizes(mj: MjModel) -> NDArray[np.float64]:
    sphere = mj.geom_type[:, None] == SPHERE
    return np.where(sphere, mj.geom_size[:, :1], mj.geom_size)


def _floor(mj: MjModel) -> float | None:
    planes = np.flatnonzero(mj.geom_type == PLANE)
    return float(mj.geom_pos[planes[0], 2]) if len(planes) else None


def _product(a: NDArray, b: NDArray) -> NDArray:
    """Quaternion product, (..., 4) each, w first."""
    w, v = a[..., :1], a[..., 1:]
    x, u = b[..., :1], b[..., 1:]
    scalar = w * x - np.sum(v * u, axis=-1, keepdims=True)
    return np.concatenate([scalar, w * u + x * v + np.cross(v, u)], axis=-1)
