"""Robots in a viser scene: N copies of one body, each part one batched mesh."""

from collections.abc import Sequence

import numpy as np
import viser
from numpy.typing import NDArray

from app.scenes.colours import linear
from app.scenes.solids import Solids


class Robot:
    """N copies of one robot, moved by `pose`."""

    def __init__(
        self,
        scene: viser.SceneApi,
        name: str,
        solids: Solids,
        colours: Sequence[tuple[int, int, int]],
        opacity: float | None = None,
    ) -> None:
        """`colours` has one colour per copy."""
        count = len(colours)
        tint = linear(np.array(colours, np.uint8))  # viser takes instance colours as intensities
        self._root = scene.add_frame(name, show_axes=False)
        self._parts = [
            scene.add_batched_meshes_simple(
                f"{name}/{i}",
                vertices,
                faces,
                batched_wxyzs=np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1)),
                batched_positions=np.zeros((count, 3), np.float32),
                batched_colors=tint,
                opacity=opacity,
                lod="off",
            )
            for i, (vertices, faces) in enumerate(solids.meshes)
        ]

    def pose(self, position: NDArray[np.float32], wxyz: NDArray[np.float32]) -> None:
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
