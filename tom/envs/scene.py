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
from tom.envs.environment import simulated

_mj: Any = mujoco  # it ships no types

CAPSULE = int(_mj.mjtGeom.mjGEOM_CAPSULE)
SPHERE = int(_mj.mjtGeom.mjGEOM_SPHERE)
ELLIPSOID = int(_mj.mjtGeom.mjGEOM_ELLIPSOID)
CYLINDER = int(_mj.mjtGeom.mjGEOM_CYLINDER)
BOX = int(_mj.mjtGeom.mjGEOM_BOX)
DRAWN = (CAPSULE, SPHERE, ELLIPSOID, CYLINDER, BOX)
PLANE = int(_mj.mjtGeom.mjGEOM_PLANE)

FREE, BALL = int(_mj.mjtJoint.mjJNT_FREE), int(_mj.mjtJoint.mjJNT_BALL)

STORED = (
    "body_parentid", "body_pos", "body_quat",
    "jnt_type", "jnt_bodyid", "jnt_pos", "jnt_axis", "jnt_qposadr",
    "geom_type", "geom_bodyid", "geom_pos", "geom_quat", "geom_size", "geom_rgba",
)  # fmt: skip
"""the arrays by their names in MuJoCo, with a row for each body, joint or geom"""

MjModel = Any
Floats = NDArray[np.float32]


@dataclass(frozen=True)
class Shape:
    """G solids of one kind over H frames; lengths in metres, colours in [0, 1]."""

    size: Floats  # capsules, cylinders (G, 2): radius, half length; others (G, 3): half sizes
    color: Floats  # (G, 4)
    center: Floats  # (H, G, 3)
    axis: Floats  # (H, G, 3) the geom's z axis; of a box its longest
    quaternion: Floats  # (H, G, 4) x, y, z, w

    @property
    def capsule_end(self) -> Floats:
        """The centre of each capsule's lower end cap, (H, G, 3)."""
        return (self.center - self.axis * self.size[:, 1:2]).astype(np.float32)


@dataclass(frozen=True)
class Geometry:
    capsules: Shape
    ellipsoids: Shape
    cylinders: Shape
    boxes: Shape
    root: Floats  # (H, 3) the first moving body
    floor: float | None  # height of the floor

    @property
    def shapes(self) -> tuple[Shape, ...]:
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
    made = build_model(task(env))
    assert made is not None, f"{env} is a MuJoCo task"
    return made


def build_model(task: Task) -> Model | None:
    """The model of a task, which is made for this; None for a task without MuJoCo."""
    made = task.make()
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
    long = np.where(mj.geom_type == BOX, mj.geom_size.argmax(1), 2)[:, None, None]
    axis = np.take_along_axis(matrix.reshape(frames, -1, 3, 3), long[None], 3)[..., 0]
    sphere, planes = mj.geom_type[:, None] == SPHERE, np.flatnonzero(mj.geom_type == PLANE)

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
        shape((SPHERE, ELLIPSOID), np.where(sphere, mj.geom_size[:, :1], mj.geom_size)),
        shape((CYLINDER,), mj.geom_size[:, :2]),
        shape((BOX,), mj.geom_size),
        root,
        float(mj.geom_pos[planes[0], 2]) if len(planes) else None,
    )


def _product(a: NDArray, b: NDArray) -> NDArray:
    """Quaternion product, (..., 4) each, w first."""
    w, v = a[..., :1], a[..., 1:]
    x, u = b[..., :1], b[..., 1:]
    scalar = w * x - np.sum(v * u, axis=-1, keepdims=True)
    return np.concatenate([scalar, w * u + x * v + np.cross(v, u)], axis=-1)


def arrays(model: Model) -> dict[str, NDArray]:
    """The arrays from which `of_arrays` rebuilds the model, without meshes and the like."""
    mj = model.mj
    stored = {name: np.array(getattr(mj, name)) for name in STORED}
    kept = np.isin(stored["geom_type"], (*DRAWN, PLANE))
    stored |= {name: stored[name][kept] for name in STORED if name.startswith("geom_")}
    view = np.array([*mj.stat.center, mj.stat.extent], np.float64)
    return stored | {"qpos0": mj.qpos0.copy(), "view": view, "dt": np.array(model.dt)}


def of_arrays(held: dict[str, NDArray]) -> Model:
    """The model of `arrays`. Raises ValueError, KeyError or IndexError if they are damaged."""
    spec = _mj.MjSpec()
    spec.compiler.degree = False
    spec.stat.center, spec.stat.extent = held["view"][:3], float(held["view"][3])
    bodies = [spec.worldbody]
    for i, parent in enumerate(held["body_parentid"][1:].tolist(), start=1):
        inertia = {"mass": 1.0, "inertia": [1.0, 1.0, 1.0], "explicitinertial": True}
        place = {"pos": held["body_pos"][i], "quat": held["body_quat"][i]}
        bodies.append(bodies[parent].add_body(**place, **inertia))
    for i, kind in enumerate(held["jnt_type"].tolist()):
        own = {"type": _mj.mjtJoint(kind), "pos": held["jnt_pos"][i], "axis": held["jnt_axis"][i]}
        if kind not in (FREE, BALL):
            own["ref"] = float(held["qpos0"][held["jnt_qposadr"][i]])
        bodies[held["jnt_bodyid"][i]].add_joint(**own)
    for i, kind in enumerate(held["geom_type"].tolist()):
        own = {name: held[f"geom_{name}"][i] for name in ("pos", "quat", "size", "rgba")}
        alone = {"contype": 0, "conaffinity": 0}
        bodies[held["geom_bodyid"][i]].add_geom(type=_mj.mjtGeom(kind), **own, **alone)
    return Model(spec.compile(), float(held["dt"]))
