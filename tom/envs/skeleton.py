"""A MuJoCo task's bodies, joints and simple geoms as arrays, and a model rebuilt from them.

A run of a user's task stores them in its folder, so that drawing it imports nothing. They are plain
numbers: MuJoCo's own files are never read, because their reader does not check them.
"""

from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from tom.envs.scene import DRAWN, Model

_mj: Any = mujoco  # it ships no types
FREE, BALL = int(_mj.mjtJoint.mjJNT_FREE), int(_mj.mjtJoint.mjJNT_BALL)
PLANE = int(_mj.mjtGeom.mjGEOM_PLANE)
JOINTS = 4
"""kinds of joints"""
MOST = 10_000
"""bodies, joints or geoms of a task"""

WIDTHS = {
    "body_parentid": (), "body_pos": (3,), "body_quat": (4,),
    "jnt_type": (), "jnt_bodyid": (), "jnt_pos": (3,), "jnt_axis": (3,), "jnt_qposadr": (),
    "geom_type": (), "geom_bodyid": (), "geom_pos": (3,), "geom_quat": (4,), "geom_size": (3,),
    "geom_rgba": (4,),
}  # fmt: skip
"""the arrays by their names in MuJoCo, with the shape for one body, joint or geom"""


def arrays(model: Model) -> dict[str, NDArray]:
    """The arrays from which `of_arrays` rebuilds the model, without meshes and the like."""
    mj = model.mj
    stored = {name: np.array(getattr(mj, name)) for name in WIDTHS}
    kept = np.isin(stored["geom_type"], (*DRAWN, PLANE))
    stored |= {name: stored[name][kept] for name in WIDTHS if name.startswith("geom_")}
    view = np.array([*mj.stat.center, mj.stat.extent], np.float64)
    return stored | {"qpos0": mj.qpos0.copy(), "view": view, "dt": np.array(model.dt)}


def of_arrays(held: dict[str, NDArray]) -> Model:
    """The model of `arrays`. Raises ValueError or KeyError if they are not a model's arrays."""
    _check(held)
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
    mj = spec.compile()
    if mj.nq != len(held["qpos0"]):
        raise ValueError("its joints do not fit together")
    return Model(mj, float(held["dt"]))


def _check(held: dict[str, NDArray]) -> None:
    """Raises ValueError or KeyError unless every array has its shape and all values are valid."""
    counts: dict[str, int] = {}
    for name, width in WIDTHS.items():
        array, kind = held[name], name.partition("_")[0]
        count = counts.setdefault(kind, len(array))
        if array.shape != (count, *width) or count > MOST or not np.isfinite(array).all():
            raise ValueError(f"{name} is not what it should be")
    if held["view"].shape != (4,) or held["qpos0"].ndim != 1 or not float(held["dt"]) > 0:
        raise ValueError("its view, joints or clock are not what they should be")
    bodies = counts["body"]
    places = np.arange(bodies)
    fine = bodies > 0 and (held["body_parentid"][1:] < places[1:]).all()
    fine &= _within(held["body_parentid"], bodies) and _within(held["jnt_bodyid"], bodies)
    fine &= _within(held["geom_bodyid"], bodies) and _within(held["jnt_type"], JOINTS)
    fine &= _within(held["jnt_qposadr"], max(len(held["qpos0"]), 1))
    if not fine or not np.isin(held["geom_type"], (*DRAWN, PLANE)).all():
        raise ValueError("it names bodies, joints or geoms that are not there")


def _within(numbers: NDArray, end: int) -> bool:
    whole = np.issubdtype(numbers.dtype, np.integer)
    return whole and bool(((numbers >= 0) & (numbers < end)).all())
