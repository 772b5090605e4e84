"""Capsules, ellipsoids, cylinders and boxes as triangle meshes with their poses. Pure functions."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from app.scenes.arrays import unit_box
from tom.envs.scene import Geometry

SEGMENTS = 20
"""number of corners of a circle around a solid"""
RINGS = 6
"""number of circles from a half sphere's rim to its pole"""

CAR_SIZES = ((0.044, 0.026, 0.012), (0.022, 0.021, 0.010))
"""body and cabin: length, width, height; the road is 0.18 wide"""

Mesh = tuple[NDArray[np.float32], NDArray[np.uint32]]


@dataclass(frozen=True)
class Solids:
    """G solid parts over H frames."""

    meshes: list[Mesh]
    position: NDArray[np.float32]  # (H, G, 3)
    wxyz: NDArray[np.float32]  # (H, G, 4)

    def __len__(self) -> int:
        return len(self.meshes)


def of(geometry: Geometry) -> Solids:
    """Every part of a MuJoCo task's geometry; lengths in metres."""
    meshes = [capsule(float(radius), float(half)) for radius, half in geometry.capsules.size]
    meshes += [ellipsoid(sizes) for sizes in geometry.ellipsoids.size]
    meshes += [cylinder(float(radius), float(half)) for radius, half in geometry.cylinders.size]
    meshes += [box(2 * sizes) for sizes in geometry.boxes.size]
    xyzw = np.concatenate([shape.quaternion for shape in geometry.shapes], 1)
    return Solids(
        meshes,
        np.concatenate([shape.center for shape in geometry.shapes], 1).astype(np.float32),
        xyzw[..., [3, 0, 1, 2]].astype(np.float32),
    )


def car(line: NDArray, above: float = 0.006) -> Solids:
    """A car at positions (H + 1, 2) of the unit square, headed to the next position.

    Its wheels are `above` the ground.
    """
    heading = headings(line)
    half = heading / 2
    zero = np.zeros_like(half)
    wxyz = np.stack([np.cos(half), zero, zero, np.sin(half)], -1)
    meshes = [box(sizes) for sizes in CAR_SIZES]
    body, cabin = CAR_SIZES[0][2], CAR_SIZES[1][2]
    height = above + np.array([body / 2, body + cabin / 2])
    back = np.array([0.0, -0.12 * CAR_SIZES[0][0]])[None, :, None]  # the cabin sits further back
    ahead = np.stack([np.cos(heading), np.sin(heading)], -1)[:, None]
    flat = line[:, None] + back * ahead
    position = np.concatenate([flat, np.broadcast_to(height[:, None], (*flat.shape[:2], 1))], -1)
    return Solids(
        meshes,
        position.astype(np.float32),
        np.repeat(wxyz[:, None], len(meshes), 1).astype(np.float32),
    )


def headings(line: NDArray) -> NDArray[np.float64]:
    """The direction (H + 1,) of travel at positions (H + 1, 2), radians; the last is repeated."""
    if len(line) < 2:
        return np.zeros(len(line))
    moves = np.diff(np.asarray(line, np.float64), axis=0)
    angle = np.arctan2(moves[:, 1], moves[:, 0])
    return np.append(angle, angle[-1])


def box(sizes: Sequence[float]) -> Mesh:
    """A box of these sizes (3,) around the origin."""
    vertices, faces = unit_box()
    return (vertices * np.asarray(sizes, np.float32)).astype(np.float32), faces


def capsule(radius: float, half_length: float) -> Mesh:
    """A capsule along z: two half spheres of `radius`, their centres 2 `half_length` apart."""
    upwards = np.linspace(0, np.pi / 2, RINGS + 1)
    rise = np.concatenate([-upwards[::-1], upwards])  # latitude of each ring, the rim twice
    shift = np.repeat([-half_length, half_length], RINGS + 1)
    turn = np.linspace(0, 2 * np.pi, SEGMENTS, endpoint=False)
    ring = radius * np.cos(rise)[:, None]
    z = radius * np.sin(rise) + shift
    corners = np.stack(
        [ring * np.cos(turn), ring * np.sin(turn), np.repeat(z[:, None], SEGMENTS, 1)], -1
    )
    return corners.reshape(-1, 3).astype(np.float32), _faces(len(rise))


def cylinder(radius: float, half_length: float) -> Mesh:
    """A cylinder along z of length 2 `half_length`, closed at both ends."""
    turn = np.linspace(0, 2 * np.pi, SEGMENTS, endpoint=False)
    # The rim of each end twice, because its normals differ from those of the side.
    rings = [(0.0, -1), (radius, -1), (radius, -1), (radius, 1), (radius, 1), (0.0, 1)]
    corners = [
        np.stack([r * np.cos(turn), r * np.sin(turn), np.full(SEGMENTS, z * half_length)], -1)
        for r, z in rings
    ]
    return np.concatenate(corners).astype(np.float32), _faces(len(rings))


def ellipsoid(half_sizes: NDArray) -> Mesh:
    """An ellipsoid with these half axes (3,)."""
    vertices, faces = capsule(1.0, 0.0)
    return (vertices * np.asarray(half_sizes, np.float32)).astype(np.float32), faces


def _faces(rings: int) -> NDArray[np.uint32]:
    """Triangles between neighbouring rings, seen from outside, without those of zero area."""
    ring, corner = np.meshgrid(np.arange(rings - 1), np.arange(SEGMENTS), indexing="ij")
    here = ring * SEGMENTS + corner
    right = ring * SEGMENTS + (corner + 1) % SEGMENTS
    lower = np.stack([here, right, right + SEGMENTS], -1)[1:]  # ring 0 is the lower pole
    upper = np.stack([here, right + SEGMENTS, here + SEGMENTS], -1)[:-1]
    return np.concatenate([lower.reshape(-1, 3), upper.reshape(-1, 3)]).astype(np.uint32)
