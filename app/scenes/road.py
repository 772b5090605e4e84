"""Road-and-rocks in 3D: columns, ground, stones and lines as arrays, and their scene nodes."""

from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np
import viser
from numpy.typing import NDArray
from trimesh import PointCloud, creation

from app.data.road import CELLS, Picture, RoadShape, cell_centres, circle, on_road, outline
from app.figures.base import OCTAVES, octaves
from app.scenes import solids
from app.scenes.frame import Vector, add_words, extent
from app.scenes.solids import Colour, Robot, copies
from app.theme import COLUMNS, NEUTRAL, Mode, learner_colour, learner_label, on_scale, rgb

CAMERA = (0.5, -0.12, 0.82)
LOOK_AT = (0.5, 0.59, 0.0)
"""behind the centre, so that the panel does not cover the map"""
TALLEST = 0.13
"""height of a column whose weight is 16 times the uniform one or more"""
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
GROUND_PIXELS, CELL_PIXELS = 400, 10
"""pixels of a side of the ground, and of a cell in the flat picture of the weights"""
DASH = 0.02
"""length of a dash of the centre line, and of the gap behind it"""
STONES = 240
STONE = [(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 0.7), (0, 0, -0.7)]
"""corners of a stone"""
_ROAD: dict[Mode, Colour] = {"light": (196, 201, 212), "dark": (66, 73, 90)}
_ROCK: dict[Mode, Colour] = {"light": (226, 221, 213), "dark": (38, 38, 44)}
_STONE: dict[Mode, Colour] = {"light": (176, 167, 155), "dark": (84, 80, 78)}
_LINE: dict[Mode, Colour] = {"light": (255, 255, 255), "dark": (205, 210, 222)}


class Fleet(Robot):
    """Cars on recorded trajectories, (H + 1, 2) each."""

    def __init__(
        self, scene: viser.SceneApi, name: str, lines: Sequence[NDArray], colour: Colour
    ) -> None:
        self._ways = [solids.car(line, TALLEST + 2 * LIFT) for line in lines if len(line)]
        self.longest = max((len(way.position) - 1 for way in self._ways), default=0)
        """steps of the longest trajectory"""
        meshes = [creation.box(sizes) for sizes in solids.CAR_SIZES]
        super().__init__(scene, name, meshes, [colour] * len(self._ways))
        self.drive(0)

    def drive(self, step: float) -> None:
        """Move every car to a step of its trajectory; arrived cars stay at the end."""
        at = [(way, min(int(step), len(way.position) - 1)) for way in self._ways]
        position, wxyz = [way.position[i] for way, i in at], [way.wxyz[i] for way, i in at]
        self.pose(np.reshape(position, (-1, 2, 3)), np.reshape(wxyz, (-1, 2, 4)))


class RoadScene:
    """One run's map: the ground is drawn once, each fit by `update`."""

    def __init__(
        self,
        scene: viser.SceneApi,
        picture: Picture,
        mode: Mode,
        number: int = 0,
        called: str = "",
    ) -> None:
        """`number` is the map's place from the left among several.

        `called` is the title above the map, by default the learner's name.
        """
        self._scene, self._name = scene, f"/road{number}"
        self._mode: Mode = mode
        scene.add_frame(self._name, show_axes=False, position=(place(number), 0.0, 0.0))
        self._called = called or learner_label(picture.learner)
        draw_map(scene, picture.road, mode, self._name)
        position, size = stones(picture.road)
        turn = np.random.default_rng(5).normal(size=(len(size), 4))
        self._stones = copies(
            scene,
            f"{self._name}/boulders",
            PointCloud(STONE).convex_hull,
            position,
            np.array(_STONE[mode], np.uint8),
            turn / np.linalg.norm(turn, axis=1, keepdims=True),
            batched_scales=size,
            flat_shading=True,
        )
        self.update(picture)

    def update(self, picture: Picture) -> None:
        """Show another fit of the same map; everything is visible until `show` is called."""
        scene, name = self._scene, self._name
        grey, colour = rgb(NEUTRAL), rgb(learner_colour(picture.learner))
        over = TALLEST + LIFT

        def arrows(kind: str, moves: NDArray, tint: Colour) -> viser.SceneNodeHandle:
            ends = segments(np.stack([picture.points, picture.points + moves], 1), 2 * LIFT)
            return scene.add_arrows(
                f"{name}/{kind}",
                ends,
                tint,
                shaft_radius=0.0014,
                head_radius=0.0042,
                head_length=0.012,
                visible=False,
            )

        self.cars = [
            Fleet(scene, f"{name}/expert cars", picture.expert[:EXPERTS], grey),
            Fleet(scene, f"{name}/learnt cars", picture.learnt, colour),
        ]
        position, scale, tint = columns(picture.grid, self._mode)
        box, flat = creation.box((1, 1, 1)), np.ones((CELL_PIXELS, CELL_PIXELS, 1), np.uint8)
        self.layers: dict[str, list[viser.SceneNodeHandle | Fleet]] = {
            "columns": [
                copies(
                    scene, f"{name}/weights", box, position, tint,
                    batched_scales=scale, flat_shading=True,
                )
            ],
            "flat": [
                scene.add_image(
                    f"{name}/flat", np.kron(cells(picture.grid, self._mode), flat), 1.0, 1.0,
                    format="png", position=(0.5, 0.5, LIFT / 2), visible=False,
                )
            ],
            "expert": [_lines(scene, f"{name}/expert", picture.expert, grey, over, 1.4)],
            "learnt": [_lines(scene, f"{name}/learnt", picture.learnt, colour, over + LIFT, 3.5)],
            "cars": [*self.cars],
            "true": [arrows("true", picture.true, grey)],
            "modelled": [arrows("modelled", picture.modelled, colour)],
            "boulders": [self._stones],
        }  # fmt: skip
        title, foot = f"{self._called}, record of step {picture.step:,}", (0.5, 1.03, 0.02)
        add_words(scene, f"{name}/title", title, self._mode, foot, TITLE, TILT)

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
        """Move every car to a step of its trajectory."""
        for fleet in self.cars:
            fleet.drive(step)


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


def _lines(
    scene: viser.SceneApi,
    name: str,
    lines: Sequence[NDArray],
    colour: Colour,
    height: float,
    thickness: float,
) -> viser.SceneNodeHandle:
    points = segments(lines, height)
    return scene.add_line_segments(
        name, points, colour, thickness=thickness, thickness_units="screen"
    )


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


def columns(
    grid: NDArray[np.float64], mode: Mode
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.uint8]]:
    """The C cells with a visible weight as columns: position, scale and colour, (C, 3) each.

    Heights are square roots, so that light cells are visible.
    """
    y, x = np.nonzero(np.nan_to_num(grid) >= 2**-OCTAVES)
    weight = grid[y, x]
    height = TALLEST * np.sqrt(np.minimum(weight, 2**OCTAVES) / 2**OCTAVES)
    middle, side = cell_centres(), np.full(len(x), 0.86 / CELLS)
    position = np.stack([middle[x], middle[y], height / 2], -1).astype(np.float32)
    scale = np.stack([side, side, height], -1).astype(np.float32)
    return position, scale, on_scale(octaves(weight) / (2 * OCTAVES) + 0.5, COLUMNS[mode])


def cells(grid: NDArray[np.float64], mode: Mode) -> NDArray[np.uint8]:
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


def stones(road: RoadShape) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Positions (K, 3) and sizes (K,) of stones beside the road, the same in every call."""
    draw = np.random.default_rng(3)
    places = draw.uniform(0.01, 0.99, (4 * STONES, 2))
    size = draw.uniform(0.004, 0.013, 4 * STONES)
    wider = RoadShape(road.centre_line, road.half_width + 0.02, road.start, road.goal)
    off = ~on_road(places, wider)
    places, size = places[off][:STONES], size[off][:STONES]
    return np.column_stack([places, size * 0.35]).astype(np.float32), size.astype(np.float32)


def segments(lines: Sequence[NDArray] | NDArray, height: float) -> NDArray[np.float32]:
    """Polylines (K, 2) as line segments (S, 2, 3) at a height."""
    parts = [np.stack([line[:-1], line[1:]], 1) for line in lines if len(line) > 1]
    flat = np.concatenate([np.zeros((0, 2, 2)), *parts])
    return np.concatenate([flat, np.full((*flat.shape[:2], 1), height)], -1).astype(np.float32)


def dashes(line: NDArray) -> list[NDArray]:
    """The dashes, (2, 2) each, of a polyline (P, 2)."""
    parts = []
    for a, b in pairwise(line):
        share = DASH / np.linalg.norm(b - a)
        parts += [
            np.stack([a + s * (b - a), a + min(s + share, 1) * (b - a)])
            for s in np.arange(0, 1, 2 * share)
        ]
    return parts
