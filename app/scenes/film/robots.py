"""Robots for a canvas: capsules as two ends and a radius, in millimetres. Pure functions."""

import base64
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tom.envs import scene as geometry

MOST = 32_767
"""millimetres; the largest number of 16 bits"""


@dataclass(frozen=True)
class Body:
    """G parts over H frames. A sphere is a capsule whose ends coincide."""

    ends: NDArray[np.int16]  # (H, G, 2, 3) millimetres, the floor at height 0
    radius: NDArray[np.int16]  # (G,) millimetres

    def plain(self) -> dict[str, Any]:
        """As JSON: the ends as base64 of little-endian numbers."""
        return {"shape": list(self.ends.shape[:2]), "ends": packed(self.ends)}


def body(model: geometry.Model, qpos: NDArray) -> Body:
    """A MuJoCo task's robot at joint positions (H, nq)."""
    shapes = geometry.geometry(model.mj, qpos)
    capsules, round_ = shapes.capsules, shapes.ellipsoids
    half = capsules.axis * capsules.size[:, 1:2]
    ends = np.stack([capsules.center - half, capsules.center + half], 2)
    ends = np.concatenate([ends, np.repeat(round_.center[:, :, None], 2, 2)], 1)
    radius = np.concatenate([capsules.size[:, 0], round_.size.mean(1)])
    lowest = float((ends[..., 2] - radius[:, None]).min()) if ends.size else 0.0
    ends[..., 2] -= lowest if shapes.floor is None else shapes.floor
    return Body(_millimetres(ends), _millimetres(radius))


def packed(numbers: NDArray) -> str:
    """Numbers as base64, little-endian, with their own bit width."""
    little = numbers.astype(numbers.dtype.newbyteorder("<"), copy=False)
    return base64.b64encode(np.ascontiguousarray(little).tobytes()).decode()


def _millimetres(metres: NDArray) -> NDArray[np.int16]:
    return np.clip(np.round(1000 * metres), -MOST, MOST).astype(np.int16)
