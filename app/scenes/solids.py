"""Capsules, ellipsoids, cylinders and boxes with their poses, and robots made of them."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import viser
from numpy.typing import ArrayLike, NDArray
from trimesh import Trimesh, creation

from app.figures.base import OCTAVES, octaves
from app.theme import COLUMNS, Mode, linear_light, scale_colours
from tom.envs import scene as geometry

SEGMENTS = 20
"""number of corners of a circle around a solid"""
RINGS = 14
"""number of circles of a capsule, from pole to pole"""
CAR_SIZES = np.array([(0.044, 0.026, 0.012), (0.022, 0.021, 0.010)])
"""body and cabin: length, width, height; the road is 0.18 wide"""
WHEELS = 0.006
"""distance of a car from the ground"""

Colour = tuple[int, int, int]
Floats = NDArray[np.float32]


@dataclass(frozen=True)
class Solids:
    """G solid parts over H frames, or over R robots and H frames; lengths in metres."""

    meshes: list[Trimesh]
    position: Floats  # (..., H, G, 3)
    wxyz: Floats  # (..., H, G, 4)
    root: Floats  # (..., H, 3)
    floor: float


def robot_solids(model: geometry.Model | None, qpos: NDArray) -> Solids:
    """A MuJoCo task's robot at joint positions (..., nq).

    Without a model it is road-and-rocks' car at positions (H, 2).
    """
    if model is None:
        return car(qpos)
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


def car(line: NDArray, above: float = WHEELS) -> Solids:
    """A car at positions (..., H, 2) of the unit square, headed to where it drives next."""
    moves = np.diff(line.astype(np.float64), axis=-2, append=line[..., -1:, :])
    moving = np.where(moves.any(-1), np.arange(line.shape[-2]), 0)
    last = np.maximum.accumulate(moving, -1)  # where it stands, it keeps its heading
    heading = np.take_along_axis(np.arctan2(moves[..., 1], moves[..., 0]), last, -1)[..., None]
    zero = np.zeros_like(heading)
    wxyz = np.stack([np.cos(heading / 2), zero, zero, np.sin(heading / 2)], -1)
    length, (body, cabin) = CAR_SIZES[0, 0], CAR_SIZES[:, 2]
    back = np.array([0.0, -0.12 * length])  # the cabin sits further back
    ahead = np.stack([np.cos(heading), np.sin(heading)], -1) * back[:, None]
    height = np.array([[above + body / 2], [above + body + cabin / 2]])
    flat = line[..., None, :] + ahead
    upright = np.broadcast_to(height, (*flat.shape[:-1], 1))
    position = np.concatenate([flat, upright], -1).astype(np.float32)
    meshes = [creation.box(sizes) for sizes in CAR_SIZES]
    wxyz = np.repeat(wxyz, len(meshes), -2).astype(np.float32)
    return Solids(meshes, position, wxyz, position[..., 0, :], 0.0)


def weight_colours(weight: NDArray, mode: Mode) -> NDArray[np.uint8]:
    """The colours (..., 3) of weights (...,): blue below average, orange above."""
    return scale_colours(octaves(weight) / (2 * OCTAVES) + 0.5, COLUMNS[mode])


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
        # viser reads instance colours as linear intensities.
        batched_colors=(255 * linear_light(colours)).round().astype(np.uint8),
        lod="off",
        **more,
    )


class Robot:
    """R robots of one kind in a scene, each part one batched mesh, moved by `pose`."""

    def __init__(
        self,
        scene: viser.SceneApi,
        name: str,
        solids: Solids,
        colours: ArrayLike,
        opacity: float | None = None,
    ) -> None:
        """`colours` are (R, 3); of a single robot the solids need no axis R."""
        self.solids = solids
        self.node = scene.add_frame(name, show_axes=False)
        tint = np.reshape(np.asarray(colours, np.uint8), (-1, 3))
        shape = (len(tint), *solids.position.shape[-3:-1])
        self._position = solids.position.reshape(*shape, 3)
        self._wxyz = solids.wxyz.reshape(*shape, 4)
        self._parts = [
            copies(scene, f"{name}/{i}", mesh, np.zeros(tint.shape), tint, opacity=opacity)
            for i, mesh in enumerate(solids.meshes)
        ]

    @property
    def frames(self) -> int:
        return self._position.shape[1]

    def pose(self, frame: float, shift: NDArray | float = 0.0) -> None:
        """Show a frame, or the last one, with the robots moved by `shift`, (3,) or (R, 1, 3)."""
        at = min(int(frame), self.frames - 1)
        position = (self._position[:, at] + shift).astype(np.float32)
        for i, part in enumerate(self._parts):
            part.batched_positions = position[:, i]
            part.batched_wxyzs = self._wxyz[:, at, i]
