"""Road-and-rocks in 3D: columns, ground, stones and lines as arrays, and their scene nodes."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import viser
from numpy.typing import NDArray
from trimesh import PointCloud, creation

from app.data.pictures import Picture
from app.data.roadmap import CELLS, RoadShape, cell_centres, circle, on_road, outline
from app.figures.scales import OCTAVES, octaves
from app.scenes import solids
from app.scenes.frame import Vector, add_words, extent
from app.scenes.solids import Robot, copies
from app.theme import COLUMNS, NEUTRAL, Mode, learner_colour, learner_label, on_scale, rgb

GROUND_PIXELS = 400
BOULDERS = 240
TALLEST = 0.13
"""height of a column whose weight is 16 times the uniform one or more"""
_ROAD = {"light": (196, 201, 212), "dark": (66, 73, 90)}
_ROCK = {"light": (226, 221, 213), "dark": (38, 38, 44)}
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
        draw_map(scene, picture.road, mode, self._name)
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
        over = TALLEST + LIFT
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
        add_words(scene, f"{name}/title", words, self.mode, foot, TITLE, TILT)

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
        self._ways = [solids.car(line, TALLEST + 2 * LIFT) for line in lines if len(line)]
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
    bars = columns(picture.grid, mode)
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
    fine = np.kron(flat(picture.grid, mode), np.ones((PIXELS, PIXELS, 1), np.uint8))
    return scene.add_image(
        name, fine, 1.0, 1.0, format="png", position=(0.5, 0.5, LIFT / 2), visible=False
    )


def draw_map(scene: viser.SceneApi, road: RoadShape, mode: Mode, root: str = "") -> None:
    """Draw the floor with the road, its start and its goal, and their names."""
    scene.add_image(
        f"{root}/ground", ground(road, mode), 1.0, 1.0, format="png", position=(0.5, 0.5, 0)
    )
    _lines(scene, f"{root}/edge", outline(road), _LINE[mode], LIFT, 2.5)
    _lines(scene, f"{root}/centre", dashes(road.centre_line), _LINE[mode], LIFT, 1.5)
    for name, (x, y, radius), colour in (
        ("start", road.start, (43, 111, 224)),
        ("goal", road.goal, (31, 157, 85)),
    ):
        ring = [circle(x, y, radius), circle(x, y, radius * 0.93)]
        _lines(scene, f"{root}/{name}", ring, colour, 2 * LIFT, 3.5)
        half = extent(name, mode, NAME)[0] / 2 + MARGIN
        beside = (-half if x < 0.5 else 1 + half, y - NAME / 2, LIFT)
        add_words(scene, f"{root}/{name}/name", name, mode, beside, NAME, TILT)


def _draw_boulders(
    scene: viser.SceneApi, road: RoadShape, mode: Mode, root: str
) -> viser.SceneNodeHandle:
    position, size = boulders(road)
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
    points = segments(lines, height)
    return scene.add_line_segments(
        name, points, colour, thickness=thickness, thickness_units="screen"
    )


def _arrows(
    scene: viser.SceneApi, name: str, points: NDArray, moves: NDArray, colour: tuple[int, int, int]
) -> viser.SceneNodeHandle:
    return scene.add_arrows(
        name,
        arrows(points, moves, 2 * LIFT),
        colour,
        shaft_radius=0.0014,
        head_radius=0.0042,
        head_length=0.012,
        visible=False,
    )


@dataclass(frozen=True)
class Columns:
    """One column for each cell with a visible weight."""

    position: NDArray[np.float32]  # (C, 3)
    scale: NDArray[np.float32]  # (C, 3)
    colour: NDArray[np.uint8]  # (C, 3)


def columns(grid: NDArray[np.float64], mode: Mode) -> Columns:
    """The weights as columns, with square-root heights so that light cells are visible."""
    y, x = np.nonzero(np.nan_to_num(grid) >= 2**-OCTAVES)
    weight = grid[y, x]
    height = TALLEST * np.sqrt(np.minimum(weight, 2**OCTAVES) / 2**OCTAVES)
    middle = cell_centres()
    return Columns(
        position=np.stack([middle[x], middle[y], height / 2], -1).astype(np.float32),
        scale=np.stack([np.full(len(x), 0.86 / CELLS)] * 2 + [height], -1).astype(np.float32),
        colour=on_scale(octaves(weight) / (2 * OCTAVES) + 0.5, COLUMNS[mode]),
    )


def flat(grid: NDArray[np.float64], mode: Mode) -> NDArray[np.uint8]:
    """The weights as a picture (CELLS, CELLS, 4), row 0 at the lowest y, empty cells clear."""
    known = np.isfinite(grid)
    share = octaves(np.where(known, grid, 1.0)) / (2 * OCTAVES) + 0.5
    alpha = np.where(known, 235, 0).astype(np.uint8)
    return np.concatenate([on_scale(share, COLUMNS[mode]), alpha[..., None]], -1)


def ground(road: RoadShape, mode: Mode) -> NDArray[np.uint8]:
    """The map's floor: (GROUND_PIXELS, GROUND_PIXELS, 3), row 0 at the lowest y."""
    middle = (np.arange(GROUND_PIXELS) + 0.5) / GROUND_PIXELS
    x, y = np.meshgrid(middle, middle)
    inside = on_road(np.stack([x.ravel(), y.ravel()], -1), road).reshape(x.shape)
    grain = np.random.default_rng(0).normal(0, 3, x.shape)[..., None]
    floor = np.where(inside[..., None], _ROAD[mode], _ROCK[mode]) + grain
    return floor.clip(0, 255).astype(np.uint8)


def boulders(road: RoadShape) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Positions (K, 3) and sizes (K,) of stones beside the road, the same in every call."""
    draw = np.random.default_rng(3)
    places = draw.uniform(0.01, 0.99, (4 * BOULDERS, 2))
    size = draw.uniform(0.004, 0.013, 4 * BOULDERS)
    off = ~on_road(
        places, RoadShape(road.centre_line, road.half_width + 0.02, road.start, road.goal)
    )
    places, size = places[off][:BOULDERS], size[off][:BOULDERS]
    return np.column_stack([places, size * 0.35]).astype(np.float32), size.astype(np.float32)


def segments(lines: Sequence[NDArray], height: float) -> NDArray[np.float32]:
    """Polylines (K, 2) as line segments (S, 2, 3) at a height."""
    parts = [np.stack([line[:-1], line[1:]], 1) for line in lines if len(line) > 1]
    flat = np.concatenate(parts) if parts else np.zeros((0, 2, 2))
    return np.concatenate([flat, np.full((*flat.shape[:2], 1), height)], -1).astype(np.float32)


def arrows(points: NDArray, moves: NDArray, height: float) -> NDArray[np.float32]:
    """Arrows (G, 2, 3) from points along displacements, at a height."""
    ends = np.stack([points, points + moves], 1)
    return np.concatenate([ends, np.full((*ends.shape[:2], 1), height)], -1).astype(np.float32)


def dashes(line: NDArray, length: float = 0.02) -> list[NDArray]:
    segments = []
    for a, b in pairwise(line):
        steps = np.arange(0, np.linalg.norm(b - a), 2 * length) / np.linalg.norm(b - a)
        share = length / np.linalg.norm(b - a)
        segments += [np.stack([a + s * (b - a), a + min(s + share, 1) * (b - a)]) for s in steps]
    return segments
