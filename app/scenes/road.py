"""Road-and-rocks in 3D: the nodes that draw a picture."""

from collections.abc import Mapping, Sequence

import numpy as np
import viser
from numpy.typing import NDArray
from trimesh import PointCloud, creation

from app.data.road import Picture, RoadShape, circle, outline
from app.scenes import arrays, solids
from app.scenes.colours import rgb
from app.scenes.solids import Robot, copies
from app.scenes.words import Vector, Words, add_words, extent
from app.theme import NEUTRAL, Mode, learner_colour, learner_label

CAMERA = (0.5, -0.12, 0.82)
LOOK_AT = (0.5, 0.59, 0.0)
"""behind the centre, so that the panel does not cover the map"""
LIFT = 0.006
"""height of lines above the surface"""
GAP = 0.18
"""between two maps side by side"""
ASPECT = 16 / 9
"""width over height of a picture whose frame is not known"""
TITLE, NAME = 0.048, 0.03
"""height of letters"""
MARGIN = 0.008
"""distance of names from the map, where columns and cars do not hide them"""
TILT = 0.7
"""tilt of words, perpendicular to the camera's first direction"""
EXPERTS = 3
"""number of cars on the expert's trajectories"""
PIXELS = 10
"""pixels of a cell in the flat picture of the weights"""
STONE = [(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 0.7), (0, 0, -0.7)]
"""corners of a stone"""
_BOULDER = {"light": (176, 167, 155), "dark": (84, 80, 78)}
_LINE = {"light": (255, 255, 255), "dark": (205, 210, 222)}


class RoadScene:
    """One run's map: the ground is drawn once, each fit by `update`."""

    def __init__(
        self,
        scene: viser.SceneApi,
        picture: Picture,
        mode: Mode,
        name: str = "",
        x: float = 0.0,
        called: str = "",
    ) -> None:
        """`name` is the prefix of its nodes' names; the map's corner is at `x`.

        `called` is the title above the map, by default the learner's name.
        """
        self._scene, self._name = scene, f"/road{name}"
        self.mode: Mode = mode
        scene.add_frame(self._name, show_axes=False, position=(x, 0.0, 0.0))
        self._called = called or learner_label(picture.learner)
        self._names = draw_map(scene, picture.road, mode, self._name)
        self._rocks = _draw_boulders(scene, picture.road, mode, self._name)
        self.update(picture)

    def update(self, picture: Picture) -> None:
        """Show another fit of the same map; everything is visible until `show` is called."""
        scene, name = self._scene, self._name
        colour = rgb(learner_colour(picture.learner))
        self.cars = [
            Fleet(scene, f"{name}/expert cars", picture.expert[:EXPERTS], rgb(NEUTRAL)),
            Fleet(scene, f"{name}/learnt cars", picture.learnt, colour),
        ]
        over = arrays.TALLEST + LIFT
        field = picture.points, picture.true, picture.modelled
        self.layers: dict[str, list[Shown]] = {
            "columns": [_columns(scene, f"{name}/weights", picture, self.mode)],
            "flat": [_flat(scene, f"{name}/flat", picture, self.mode)],
            "expert": [_lines(scene, f"{name}/expert", picture.expert, rgb(NEUTRAL), over, 1.4)],
            "learnt": [_lines(scene, f"{name}/learnt", picture.learnt, colour, over + LIFT, 3.5)],
            "cars": [*self.cars],
            "true": [_arrows(scene, f"{name}/true", field[0], field[1], rgb(NEUTRAL))],
            "modelled": [_arrows(scene, f"{name}/modelled", field[0], field[2], colour)],
            "boulders": [self._rocks],
        }
        words, foot = f"{self._called}, record of step {picture.step:,}", (0.5, 1.03, 0.02)
        self._title = add_words(scene, f"{name}/title", words, self.mode, foot, TITLE, TILT)

    @property
    def words(self) -> list[Words]:
        """The words on the map."""
        return [self._title, *self._names]

    def show(self, layers: Mapping[str, bool]) -> None:
        """Show and hide layers by name."""
        for name, shown in layers.items():
            for node in self.layers[name]:
                node.visible = shown

    @property
    def longest(self) -> int:
        """The number of steps of the longest trajectory."""
        return max(fleet.longest for fleet in self.cars)

    def drive(self, step: float) -> None:
        """Move every car to a step of its trajectory; arrived cars stay at the end."""
        for fleet in self.cars:
            fleet.drive(step)


class Fleet:
    """Cars on recorded trajectories."""

    def __init__(
        self,
        scene: viser.SceneApi,
        name: str,
        lines: Sequence[NDArray],
        colour: tuple[int, int, int],
    ) -> None:
        self._ways = [solids.car(line, arrays.TALLEST + 2 * LIFT) for line in lines if len(line)]
        self._robot = (
            Robot(scene, name, self._ways[0].meshes, [colour] * len(self._ways))
            if self._ways
            else None
        )
        self.drive(0)

    @property
    def longest(self) -> int:
        """The number of steps of the longest trajectory."""
        return max((len(way.position) - 1 for way in self._ways), default=0)

    def drive(self, step: float) -> None:
        """Move every car to a step of its trajectory."""
        if self._robot is None:
            return
        at = [min(int(step), len(way.position) - 1) for way in self._ways]
        self._robot.pose(
            np.stack([way.position[i] for way, i in zip(self._ways, at, strict=True)]),
            np.stack([way.wxyz[i] for way, i in zip(self._ways, at, strict=True)]),
        )

    @property
    def visible(self) -> bool:
        return self._robot is not None and self._robot.visible

    @visible.setter
    def visible(self, shown: bool) -> None:
        if self._robot is not None:
            self._robot.visible = shown


Shown = viser.SceneNodeHandle | Fleet


def place(number: int) -> float:
    """The x of the corner of the map `number` among several."""
    return number * (1 + GAP)


def view(count: int, fov: float, aspect: float = ASPECT) -> tuple[Vector, Vector]:
    """The camera's position and target for `count` maps side by side.

    It goes back until their front corners, with the words beside them, are in a picture that is
    `fov` radians high and `aspect` times as wide.
    """
    (_, y, z), (_, at, ground) = CAMERA, LOOK_AT
    back = np.hypot(at - y, z)
    nearer = at * (at - y) / back  # by this the maps' front edge is nearer than the target
    half = place(count) / 2
    away = max(1.0, float(half / (aspect * np.tan(fov / 2)) + nearer) / back)
    middle = half - GAP / 2
    return (middle, at + (y - at) * away, z * away), (middle, at, ground)


def _columns(
    scene: viser.SceneApi, name: str, picture: Picture, mode: Mode
) -> viser.SceneNodeHandle:
    bars = arrays.columns(picture.grid, mode)
    return copies(
        scene,
        name,
        creation.box((1, 1, 1)),
        bars.position,
        bars.colour,
        batched_scales=bars.scale,
        flat_shading=True,
    )


def _flat(scene: viser.SceneApi, name: str, picture: Picture, mode: Mode) -> viser.SceneNodeHandle:
    fine = np.kron(arrays.flat(picture.grid, mode), np.ones((PIXELS, PIXELS, 1), np.uint8))
    return scene.add_image(
        name, fine, 1.0, 1.0, format="png", position=(0.5, 0.5, LIFT / 2), visible=False
    )


def draw_map(scene: viser.SceneApi, road: RoadShape, mode: Mode, root: str = "") -> list[Words]:
    """Draw the floor with the road, its start and its goal; returns their words."""
    names = []
    scene.add_image(
        f"{root}/ground", arrays.ground(road, mode), 1.0, 1.0, format="png", position=(0.5, 0.5, 0)
    )
    _lines(scene, f"{root}/edge", outline(road), _LINE[mode], LIFT, 2.5)
    _lines(scene, f"{root}/centre", arrays.dashes(road.centre_line), _LINE[mode], LIFT, 1.5)
    for name, (x, y, radius), colour in (
        ("start", road.start, (43, 111, 224)),
        ("goal", road.goal, (31, 157, 85)),
    ):
        ring = [circle(x, y, radius), circle(x, y, radius * 0.93)]
        _lines(scene, f"{root}/{name}", ring, colour, 2 * LIFT, 3.5)
        half = extent(name, mode, NAME)[0] / 2 + MARGIN
        beside = (-half if x < 0.5 else 1 + half, y - NAME / 2, LIFT)
        names.append(add_words(scene, f"{root}/{name}/name", name, mode, beside, NAME, TILT))
    return names


def _draw_boulders(
    scene: viser.SceneApi, road: RoadShape, mode: Mode, root: str
) -> viser.SceneNodeHandle:
    position, size = arrays.boulders(road)
    turn = np.random.default_rng(5).normal(size=(len(size), 4))
    return copies(
        scene,
        f"{root}/boulders",
        PointCloud(STONE).convex_hull,
        position,
        np.array(_BOULDER[mode], np.uint8),
        turn / np.linalg.norm(turn, axis=1, keepdims=True),
        batched_scales=size,
        flat_shading=True,
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
