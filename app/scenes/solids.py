"""Capsules, ellipsoids, cylinders and boxes with their poses, and robots made of them."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray
from trimesh import Trimesh, creation

from tom.envs import scene as geometry

SEGMENTS = 20
"""number of corners of a circle around a solid"""
RINGS = 14
"""number of circles of a capsule, from pole to pole"""
CAR_SIZES = ((0.044, 0.026, 0.012), (0.022, 0.021, 0.010))
"""body and cabin: length, width, height; the road is 0.18 wide"""

Colour = tuple[int, int, int]
Floats = NDArray[np.float32]


@dataclass(frozen=True)
class Solids:
    """G solid parts over H frames, or over R robots and H frames; lengths in metres."""

    meshes: list[Trimesh]
    position: Floats  # (..., G, 3)
    wxyz: Floats  # (..., G, 4)
    root: Floats  # (..., 3)
    floor: float


def of(model: geometry.Model, qpos: NDArray) -> Solids:
    """A MuJoCo task's robot at joint positions (..., nq)."""
    frames = qpos.shape[:-1]
    shapes = geometry.geometry(model.mj, qpos.reshape(-1, qpos.shape[-1]))
    meshes = [
        creation.capsule(2 * half, radius, count=(RINGS, SEGMENTS))
        for radius, half in shapes.capsules.size.astype(float)
    ]
    meshes += [creation.icosphere(2).apply_scale(half) for half in shapes.ellipsoids.size]
    meshes += [  # smooth: the rims are there twice, as the ends' normals are not those of the side
        creation.cylinder(radius, 2 * half, sections=SEGMENTS).smooth_shaded
        for radius, half in shapes.cylinders.size.astype(float)
    ]
    meshes += [creation.box(2 * half) for half in shapes.boxes.size]
    position = np.concatenate([shape.center for shape in shapes.shapes], 1)
    xyzw = np.concatenate([shape.quaternion for shape in shapes.shapes], 1)
    return Solids(
        meshes,
        position.reshape(*frames, -1, 3),
        xyzw[..., [3, 0, 1, 2]].reshape(*frames, -1, 4),
        shapes.root.reshape(*frames, 3),
        shapes.ground,
    )


def car(line: NDArray, above: float = 0.006) -> Solids:
    """A car at positions (H + 1, 2) of the unit square, headed to the next position.

    Its wheels are `above` the ground.
    """
    moves = np.diff(np.asarray(line, np.float64), axis=0)
    heading = np.arctan2(moves[:, 1], moves[:, 0])
    heading = np.append(heading, heading[-1:] if len(moves) else 0.0)  # the last one is kept
    zero = np.zeros_like(heading)
    wxyz = np.stack([np.cos(heading / 2), zero, zero, np.sin(heading / 2)], -1)
    body, cabin = CAR_SIZES[0][2], CAR_SIZES[1][2]
    height = above + np.array([body / 2, body + cabin / 2])
    back = np.array([0.0, -0.12 * CAR_SIZES[0][0]])[None, :, None]  # the cabin sits further back
    ahead = np.stack([np.cos(heading), np.sin(heading)], -1)[:, None]
    flat = line[:, None] + back * ahead
    upright = np.broadcast_to(height[:, None], (*flat.shape[:2], 1))
    position = np.concatenate([flat, upright], -1).astype(np.float32)
    return Solids(
        [creation.box(sizes) for sizes in CAR_SIZES],
        position,
        np.repeat(wxyz[:, None], len(CAR_SIZES), 1).astype(np.float32),
        position[:, 0],
        0.0,
    )


def linear(colours: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """sRGB colours as light intensities, both 0 to 255 (IEC 61966-2-1)."""
    share = np.asarray(colours, np.float64) / 255
    light = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    return (255 * light).round().astype(np.uint8)


def copies(
    scene: viser.SceneApi,
    name: str,
    mesh: Trimesh,
    position: NDArray,
    colours: NDArray[np.uint8],
    wxyz: NDArray | None = None,
    **more: Any,
) -> viser.BatchedMeshHandle:
    """N copies of a mesh at position (N, 3) and orientation (N, 4), by default upright."""
    return scene.add_batched_meshes_simple(
        name,
        np.asarray(mesh.vertices, np.float32),
        np.asarray(mesh.faces, np.uint32),
        batched_wxyzs=np.tile([1, 0, 0, 0], (len(position), 1)) if wxyz is None else wxyz,
        batched_positions=position,
        batched_colors=linear(colours),  # viser reads instance colours as linear intensities
        lod="off",
        **more,
    )


class Robot:
    """N copies of one robot, each part one batched mesh, moved by `pose`."""

    def __init__(
        self,
        scene: viser.SceneApi,
        name: str,
        meshes: Sequence[Trimesh],
        colours: Sequence[Colour],
        opacity: float | None = None,
    ) -> None:
        """`colours` has one colour per copy."""
        self._root = scene.add_frame(name, show_axes=False)
        tint = np.reshape(np.array(colours, np.uint8), (-1, 3))
        self._parts = [
            copies(scene, f"{name}/{i}", mesh, np.zeros(tint.shape), tint, opacity=opacity)
            for i, mesh in enumerate(meshes)
        ]

    def pose(self, position: Floats, wxyz: Floats) -> None:
        """Set the parts of every copy to position (N, G, 3) and orientation (N, G, 4)."""
        for i, part in enumerate(self._parts):
            part.batched_positions = position[:, i]
            part.batched_wxyzs = wxyz[:, i]

    @property
    def visible(self) -> bool:
        return self._root.visible

    @visible.setter
    def visible(self, shown: bool) -> None:
        self._root.visible = shown
