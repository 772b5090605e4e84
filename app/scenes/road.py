"""Road-and-rocks in 3D: in a browser frame, and as one HTML file that plays without a server."""

from collections.abc import Mapping, Sequence

import numpy as np
import viser
from numpy.typing import NDArray
from trimesh import PointCloud, creation

from app.data import road
from app.data.readers import folder_reader
from app.data.road import CELLS, CENTRES, Picture, RoadShape, circle, on_road, outline
from app.data.run_names import distinct_names
from app.figures.base import OCTAVES
from app.figures.road import GOAL, START
from app.scenes import solids
from app.scenes.control import RoadChoice
from app.scenes.frame import ASPECT, Frame, Vector, add_text, set_up_lights, stand_back, text_extent
from app.scenes.solids import Colour, Robot, copies, weight_colours
from app.theme import NEUTRAL, Mode, learner_colour, rgb
from tom.machine.address import free_port
from tom.record.reader import RunReader

LAYERS = (
    ("columns", "weights as columns", True),
    ("flat", "weights as colours", False),
    ("expert", "expert's paths", True),
    ("learnt", "learnt policy's paths", True),
    ("cars", "cars", True),
    ("true", "real displacement", False),
    ("modelled", "modelled displacement", False),
    ("boulders", "rocks", True),
)
PLAY_S = 1.0
"""seconds for which each fit is shown during playback"""
STEPS_PER_S, REST = 20.0, 20
"""steps of the task that the cars drive per second, and that they wait after they have arrived"""
FRAME_S, STRIDE, REST_S = 0.1, 2, 1.0
"""of a film: seconds between two frames, steps of the task, and seconds after the cars' arrival"""

CAMERA = (-0.12, 0.82)
LOOK_AT = (0.59, 0.0)
"""y and z; behind the centre, so that the panel does not cover the map"""
TALLEST = 0.13
"""height of a column whose weight is 16 times the uniform one or more"""
LIFT = 0.006
"""height of lines above the surface"""
GAP = 0.18
"""between two maps side by side"""
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


class RoadScene:
    """One run's map: the ground is drawn once, each fit by `update`."""

    def __init__(
        self, scene: viser.SceneApi, picture: Picture, mode: Mode, number: int, title: str
    ) -> None:
        """`number` is the map's place from the left, `title` stands above it."""
        self._scene, self._name = scene, f"/road{number}"
        self._mode: Mode = mode
        self._title = title
        scene.add_frame(self._name, show_axes=False, position=(map_x(number), 0.0, 0.0))
        draw_map(scene, picture.road, mode, self._name)
        position, size = stones(picture.road)
        turn = np.random.default_rng(5).normal(size=(len(size), 4))
        self._stones = copies(
            scene, f"{self._name}/boulders", PointCloud(STONE).convex_hull, position,
            np.array(_STONE[mode], np.uint8), turn / np.linalg.norm(turn, axis=1, keepdims=True),
            batched_scales=size, flat_shading=True,
        )  # fmt: skip
        self.update(picture)

    def update(self, picture: Picture) -> None:
        """Show another fit of the same map; everything is visible until `show` is called."""
        scene, name = self._scene, self._name
        grey, colour = rgb(NEUTRAL), rgb(learner_colour(picture.learner))
        over = TALLEST + LIFT

        def arrows(kind: str, moves: NDArray, tint: Colour) -> viser.SceneNodeHandle:
            ends = segments(np.stack([picture.points, picture.points + moves], 1), 2 * LIFT)
            return scene.add_arrows(
                f"{name}/{kind}", ends, tint,
                shaft_radius=0.0014, head_radius=0.0042, head_length=0.012, visible=False,
            )  # fmt: skip

        def cars(whose: str, lines: Sequence[NDArray], tint: Colour) -> Robot:
            driven = solids.car(padded(lines), over + LIFT)
            return Robot(scene, f"{name}/{whose} cars", driven, [tint] * len(lines))

        self.cars = [
            cars("expert", picture.expert[:EXPERTS], grey),
            cars("learnt", picture.learnt, colour),
        ]
        self.drive(0)
        position, scale, tint = columns(picture.grid, self._mode)
        box, flat = creation.box((1, 1, 1)), np.ones((CELL_PIXELS, CELL_PIXELS, 1), np.uint8)
        self.layers: dict[str, list[viser.SceneNodeHandle]] = {
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
            "cars": [car.node for car in self.cars],
            "true": [arrows("true", picture.true, grey)],
            "modelled": [arrows("modelled", picture.modelled, colour)],
            "boulders": [self._stones],
        }  # fmt: skip
        title, foot = f"{self._title}, record of step {picture.step:,}", (0.5, 1.03, 0.02)
        add_text(scene, f"{name}/title", title, self._mode, foot, TITLE, TILT)

    def show(self, layers: Mapping[str, bool]) -> None:
        """Show and hide layers by name."""
        for name, shown in layers.items():
            for node in self.layers[name]:
                node.visible = shown

    @property
    def longest(self) -> int:
        """The number of steps of the longest trajectory."""
        return max(cars.frames for cars in self.cars) - 1

    def drive(self, step: float) -> None:
        """Move every car to a step of its trajectory."""
        for cars in self.cars:
            cars.pose(step)


def draw_map(scene: viser.SceneApi, road: RoadShape, mode: Mode, root: str = "") -> None:
    """Draw the floor with the road, its start and its goal, and their names."""
    scene.add_image(
        f"{root}/ground", ground(road, mode), 1.0, 1.0, format="png", position=(0.5, 0.5, 0)
    )
    _lines(scene, f"{root}/edge", [outline(road)], _LINE[mode], LIFT, 2.5)
    _lines(scene, f"{root}/centre", dashes(road.centre_line), _LINE[mode], LIFT, 1.5)
    for name, (x, y, radius), colour in (
        ("start", road.start, rgb(START)),
        ("goal", road.goal, rgb(GOAL)),
    ):
        ring = [circle(x, y, radius), circle(x, y, radius * 0.93)]
        _lines(scene, f"{root}/{name}", ring, colour, 2 * LIFT, 3.5)
        half = text_extent(name, mode, NAME)[0] / 2 + MARGIN
        beside = (-half if x < 0.5 else 1 + half, y - NAME / 2, LIFT)
        add_text(scene, f"{root}/{name}/name", name, mode, beside, NAME, TILT)


def _lines(
    scene: viser.SceneApi,
    name: str,
    lines: Sequence[NDArray],
    colour: Colour,
    height: float,
    thickness: float,
) -> viser.SceneNodeHandle:
    return scene.add_line_segments(
        name, segments(lines, height), colour, thickness=thickness, thickness_units="screen"
    )


def map_x(number: int) -> float:
    """The x of the corner of the map `number` among several."""
    return number * (1 + GAP)


def camera_for(count: int) -> tuple[Vector, Vector, Vector]:
    """The camera's position and target for `count` maps side by side, and their front corner.

    The words beside the maps are within the corner.
    """
    middle = (map_x(count) - GAP) / 2
    return (middle, *CAMERA), (middle, *LOOK_AT), (-GAP / 2, 0.0, 0.0)


def columns(
    grid: NDArray[np.float64], mode: Mode
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.uint8]]:
    """The C cells with a visible weight as columns: position, scale and colour, (C, 3) each.

    Heights are square roots, so that light cells are visible.
    """
    y, x = np.nonzero(np.nan_to_num(grid) >= 2**-OCTAVES)
    weight = grid[y, x]
    height = TALLEST * np.sqrt(np.minimum(weight, 2**OCTAVES) / 2**OCTAVES)
    side = np.full(len(x), 0.86 / CELLS)
    position = np.stack([CENTRES[x], CENTRES[y], height / 2], -1).astype(np.float32)
    scale = np.stack([side, side, height], -1).astype(np.float32)
    return position, scale, weight_colours(weight, mode)


def cells(grid: NDArray[np.float64], mode: Mode) -> NDArray[np.uint8]:
    """The weights as a picture (CELLS, CELLS, 4), row 0 at the lowest y, empty cells clear."""
    alpha = np.where(np.isfinite(grid), 235, 0).astype(np.uint8)
    return np.dstack([weight_colours(np.nan_to_num(grid, nan=1.0), mode), alpha])


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
    off = ~on_road(places, road, 0.02)
    places, size = places[off][:STONES], size[off][:STONES]
    return np.column_stack([places, size * 0.35]).astype(np.float32), size.astype(np.float32)


def segments(lines: Sequence[NDArray] | NDArray, height: float) -> NDArray[np.float32]:
    """Polylines (K, 2) as line segments (S, 2, 3) at a height."""
    parts = [np.stack([line[:-1], line[1:]], 1) for line in lines if len(line) > 1]
    flat = np.concatenate([np.zeros((0, 2, 2)), *parts])
    return np.concatenate([flat, np.full((*flat.shape[:2], 1), height)], -1).astype(np.float32)


def dashes(line: NDArray) -> list[NDArray]:
    """The dashes, (2, 2) each, of a polyline (P, 2), as long as the gaps between them."""
    along = np.append(0, np.linalg.norm(np.diff(line, axis=0), axis=1).cumsum())
    at = np.arange(0, along[-1], DASH)
    ends = np.stack([np.interp(at, along, axis) for axis in line.T], 1)
    return list(ends[: len(ends) // 2 * 2].reshape(-1, 2, 2))


def padded(lines: Sequence[NDArray]) -> NDArray:
    """R lines (H, 2) as one array (R, longest, 2); the shorter ones stay at their ends."""
    longest = np.arange(max(map(len, lines), default=1))
    whole = [line[np.minimum(longest, len(line) - 1)] for line in lines]
    return np.reshape(whole, (-1, len(longest), 2))


class RoadFrame(Frame):
    """Shows fits of road-and-rocks runs side by side."""

    title = "Road and rocks"
    folded = False

    def _build_panel(self) -> None:
        self._runs: list[RunReader] = []
        self._steps: list[int] = []
        self._scenes: list[RoadScene] = []
        self._chosen = self._shown = -1
        self._since = self._driven = 0.0
        gui = self.client.gui
        self.play = gui.add_checkbox("play the fits", initial_value=False)
        self.drive = gui.add_checkbox("let the cars drive", initial_value=False)
        with gui.add_folder("Layers", expand_by_default=False):
            self.layers = {
                name: gui.add_checkbox(label, initial_value=shown) for name, label, shown in LAYERS
            }
        self.play.on_update(lambda _: self._show_step(self._chosen))
        for layer in self.layers.values():
            layer.on_update(lambda _: self._apply_layers())

    def _show(self, choice: RoadChoice, *, obey: bool) -> None:
        self._runs = [folder_reader(folder) for folder in choice.runs]
        self._steps = sorted({step for run in self._runs for step in road.steps(run)})
        self._chosen = choice.step
        self._show_step(choice.step)

    def _tick(self, seconds: float) -> None:
        """Advance to the next fit if the fits play, in a loop, and move the cars."""
        self._since += seconds
        if self.play.value and self._steps and self._since >= PLAY_S:
            self._since = 0.0
            later = [step for step in self._steps if step > self._shown]
            self._show_step((later or self._steps)[0])
        if self.drive.value:
            longest = max((each.longest for each in self._scenes), default=0)
            self._driven = (self._driven + seconds * STEPS_PER_S) % (longest + REST)
            self._drive()

    def _show_step(self, step: int) -> None:
        """Show each run's last fit up to a step."""
        with self._lock:
            self._shown = step
            shown = [(run, fit) for run in self._runs if (fit := road.fit(run, step)) is not None]
            drawn = [(run.run_id, picture.step) for run, picture in shown]
            if drawn == self._drawn or not shown:
                return
            same = self._drawn is not None and [r for r, _ in drawn] == [r for r, _ in self._drawn]
            with self.client.atomic():
                if same:
                    for each, (_, picture) in zip(self._scenes, shown, strict=True):
                        each.update(picture)
                else:
                    self._draw(shown)
                self._apply_layers()
                self._drive()
            self._drawn = drawn

    def _draw(self, shown: list[tuple[RunReader, Picture]]) -> None:
        if len(shown) != len(self._scenes):
            self.set_camera(*camera_for(len(shown)))
        self.clear()
        called = distinct_names([run for run, _ in shown])
        self._scenes = [
            RoadScene(self.client.scene, picture, self.mode, i, called[run.run_id])
            for i, (run, picture) in enumerate(shown)
        ]

    def _drive(self) -> None:
        for each in self._scenes:
            each.drive(self._driven)

    def _apply_layers(self) -> None:
        with self._lock:
            for each in self._scenes:
                each.show({name: bool(box.value) for name, box in self.layers.items()})


def as_html(fits: Sequence[Sequence[Picture]], mode: Mode, titles: Sequence[str]) -> str:
    """The pictures of R runs at F fits, (F, R), as a self-contained page; `titles` are (R,).

    Its timeline shows the fits one after another; in each the cars drive their whole way. It is
    made by a temporary viser server in this process.
    """
    here = "127.0.0.1"
    server = viser.ViserServer(here, free_port(here), verbose=False)
    try:
        server.scene.set_up_direction("+z")
        server.scene.configure_environment_map(None)
        set_up_lights(server.scene, mode, front=0.5)
        server.scene.world_axes.visible = False
        camera = server.initial_camera
        position, at, corner = camera_for(len(fits[0]))
        camera.position = stand_back(position, at, corner, camera.fov, ASPECT)
        camera.look_at = at
        scenes = [
            RoadScene(server.scene, picture, mode, i, title)
            for i, (picture, title) in enumerate(zip(fits[0], titles, strict=True))
        ]
        film = server.get_scene_serializer()
        for number, fit in enumerate(fits):
            for each, picture in zip(scenes, fit, strict=True):
                if number:
                    each.update(picture)
                each.show({name: shown for name, _, shown in LAYERS})
            for step in range(0, max(each.longest for each in scenes) + STRIDE, STRIDE):
                for each in scenes:
                    each.drive(step)
                film.insert_sleep(FRAME_S)
            film.insert_sleep(REST_S)
        return film.as_html(dark_mode=mode == "dark")
    finally:
        server.stop()
