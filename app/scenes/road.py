"""Road-and-rocks in 3D: the nodes that draw a picture."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import viser
from numpy.typing import NDArray

from app.colours import linear, rgb
from app.pictures import Picture
from app.roadmap import RoadMap, circle, outline
from app.scenes import arrays
from app.theme import NEUTRAL, Mode, learner_colour

CAMERA = (0.5, -0.12, 0.82)
LOOK_AT = (0.5, 0.45, 0.0)
LIFT = 0.006
"""lines lie this much above what they are drawn on"""
_BOULDER = {"light": (176, 167, 155), "dark": (84, 80, 78)}
_LINE = {"light": (255, 255, 255), "dark": (205, 210, 222)}


@dataclass
class Handles:
    """The nodes of a scene that layers show and hide."""

    columns: viser.SceneNodeHandle
    expert: viser.SceneNodeHandle
    learnt: viser.SceneNodeHandle
    true: viser.SceneNodeHandle
    modelled: viser.SceneNodeHandle
    boulders: viser.SceneNodeHandle


def draw(scene: viser.SceneApi, picture: Picture, mode: Mode) -> Handles:
    """Draw all of a picture; nodes of an earlier one of the same name are replaced."""
    draw_map(scene, picture.road, mode)
    colour = rgb(learner_colour(picture.learner))
    bars = arrays.columns(picture.grid)
    vertices, faces = arrays.unit_box()
    return Handles(
        columns=scene.add_batched_meshes_simple(
            "/weights",
            vertices,
            faces,
            batched_wxyzs=arrays.upright(len(bars.position)),
            batched_positions=bars.position,
            batched_scales=bars.scale,
            batched_colors=linear(bars.colour),  # viser takes instance colours as intensities
            flat_shading=True,
            lod="off",
        ),
        expert=_lines(scene, "/expert", picture.expert, rgb(NEUTRAL), arrays.TALLEST + LIFT, 1.4),
        learnt=_lines(scene, "/learnt", picture.learnt, colour, arrays.TALLEST + 2 * LIFT, 3.5),
        true=_arrows(scene, "/true", picture.points, picture.true, rgb(NEUTRAL)),
        modelled=_arrows(scene, "/modelled", picture.points, picture.modelled, colour),
        boulders=_draw_boulders(scene, picture.road, mode),
    )


def draw_map(scene: viser.SceneApi, road: RoadMap, mode: Mode) -> None:
    """The floor with the road, its start and its goal."""
    scene.add_image(
        "/ground", arrays.ground(road, mode), 1.0, 1.0, format="png", position=(0.5, 0.5, 0)
    )
    _lines(scene, "/edge", outline(road), _LINE[mode], LIFT, 2.5)
    _lines(scene, "/centre", arrays.dashes(road.centre_line), _LINE[mode], LIFT, 1.5)
    for name, (x, y, radius), colour in (
        ("start", road.start, (43, 111, 224)),
        ("goal", road.goal, (31, 157, 85)),
    ):
        ring = [circle(x, y, radius), circle(x, y, radius * 0.93)]
        _lines(scene, f"/{name}", ring, colour, 2 * LIFT, 3.5)
        scene.add_label(f"/{name}/name", name, position=(x, y, 0.03), anchor="bottom-center")


def _draw_boulders(scene: viser.SceneApi, road: RoadMap, mode: Mode) -> viser.SceneNodeHandle:
    position, size = arrays.boulders(road)
    vertices, faces = arrays.stone()
    turn = np.random.default_rng(5).normal(size=(len(size), 4))
    return scene.add_batched_meshes_simple(
        "/boulders",
        vertices,
        faces,
        batched_wxyzs=turn / np.linalg.norm(turn, axis=1, keepdims=True),
        batched_positions=position,
        batched_scales=size,
        batched_colors=linear(np.array(_BOULDER[mode], np.uint8)),
        flat_shading=True,
        lod="off",
    )


def _lines(
    scene: viser.SceneApi,
    name: str,
    lines: Sequence[NDArray],
    colour: tuple[int, int, int],
    height: float,
    thickness: float,
) -> viser.SceneNodeHandle:
    points = arrays.segments(lines, height)
    return scene.add_line_segments(
        name, points, colour, thickness=thickness, thickness_units="screen"
    )


def _arrows(
    scene: viser.SceneApi, name: str, points: NDArray, moves: NDArray, colour: tuple[int, int, int]
) -> viser.SceneNodeHandle:
    return scene.add_arrows(
        name,
        arrays.arrows(points, moves, 2 * LIFT),
        colour,
        shaft_radius=0.0014,
        head_radius=0.0042,
        head_length=0.012,
        visible=False,
    )
