"""Robots for a canvas: capsules as two ends and a radius, in millimetres. Pure functions."""

import base64
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tom.envs import Task
from tom.envs import scene as geometry

MOST = 32_767
"""millimetres; the largest number of 16 bits"""


def body(model: geometry.Model, qpos: NDArray) -> dict[str, Any]:
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


def travelling(known: Task, model: geometry.Model, qpos: NDArray) -> dict[str, Any]:
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
