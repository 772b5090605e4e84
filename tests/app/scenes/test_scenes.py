"""The 3D scene: what is drawn, with its words, and that a frame shows what its page chose."""

import base64
import queue
import re
import socket
import threading
from collections.abc import Iterator
from multiprocessing.connection import Client
from pathlib import Path

import msgspec
import numpy as np
import pytest
import viser
import viser.transforms
import zstandard
from kernel import wait_for
from studio_pages import answers
from studio_runs import ROAD_MLE, ROAD_TOM

from app.data import road
from app.data.road import CELLS, on_road
from app.scenes import road as scene
from app.scenes.control import (
    ReplayChoice,
    RoadChoice,
    Selection,
    StatesChoice,
    listen,
    tell,
)
from app.scenes.frame import PIXELS, add_words, extent, painted
from app.scenes.road import FRAME_S, LAYERS, REST_S, STRIDE, RoadScene, as_html
from app.theme import BACKGROUND, TEXT, Mode, rgb
from tom.machine.address import free_port
from tom.record.reader import RunReader

FOV = float(np.radians(75))
"""viser's own field of view"""


@pytest.fixture(scope="module")
def picture(store: Path) -> road.Picture:
    found = road.picture(RunReader(store / ROAD_TOM), 60)
    assert found is not None
    return found


def test_a_cell_with_weight_is_a_column(picture: road.Picture) -> None:
    position, scale, _ = scene.columns(picture.grid, "light")
    heavy = np.nan_to_num(picture.grid) >= 1 / 16
    assert len(position) == heavy.sum() > 100
    i = int(np.argmax(scale[:, 2]))
    x, y = (position[i, :2] * CELLS).astype(int)
    assert picture.grid[y, x] >= 16 or picture.grid[y, x] == np.nanmax(picture.grid)
    assert position[:, 2] == pytest.approx(scale[:, 2] / 2)
    assert scale[:, 2].max() <= scene.TALLEST + 1e-6
    tall = scale[:, 2] > scene.TALLEST / 2
    assert on_road(position[tall, :2], picture.road).mean() > 0.9


def test_height_and_colour_grow_with_the_weight_and_an_empty_cell_is_clear() -> None:
    grid = np.full((CELLS, CELLS), np.nan)
    grid[0, :4] = [0.01, 1, 4, 100]
    _, scale, colour = scene.columns(grid, "light")
    assert scale[:, 2] == pytest.approx(scene.TALLEST * np.array([0.25, 0.5, 1]))
    assert colour[2].tolist() == [194, 44, 6]
    flat = scene.cells(grid, "light")
    assert flat[0, 3].tolist() == [194, 44, 6, 235]
    assert flat[..., 3].sum() == 4 * 235


def test_stones_lie_beside_the_road(picture: road.Picture) -> None:
    position, size = scene.stones(picture.road)
    assert len(position) == len(size) > 100
    assert not on_road(position[:, :2], picture.road).any()


def test_lines_become_segments() -> None:
    line = np.array([[0, 0], [1, 0], [1, 1]])
    assert scene.segments([line, line[:1]], 0.5).tolist() == [
        [[0, 0, 0.5], [1, 0, 0.5]],
        [[1, 0, 0.5], [1, 1, 0.5]],
    ]
    assert scene.segments([], 0).shape == (0, 2, 3)


@pytest.fixture(scope="module")
def server() -> Iterator[viser.ViserServer]:
    made = viser.ViserServer("127.0.0.1", free_port("127.0.0.1"), verbose=False)
    yield made
    made.stop()


def test_a_fit_takes_the_place_of_another(
    server: viser.ViserServer, picture: road.Picture, store: Path
) -> None:
    drawn = RoadScene(server.scene, picture, "light", 0, "TOM")
    before = drawn.layers["columns"][0]
    other = road.picture(RunReader(store / ROAD_MLE), 60)
    assert other is not None
    drawn.update(other)
    assert drawn.layers["columns"][0] is not before
    assert set(drawn.layers) == {name for name, _, _ in LAYERS}
    drawn.show({"columns": False, "flat": True, "cars": False})
    assert not drawn.layers["columns"][0].visible
    assert drawn.layers["flat"][0].visible
    assert not any(car.node.visible for car in drawn.cars)


@pytest.mark.parametrize("aspect", [0.6, 16 / 9, 3.0])
@pytest.mark.parametrize("count", [1, 2, 4])
def test_every_map_is_in_the_picture_however_wide_it_is(count: int, aspect: float) -> None:
    assert np.ravel(scene.view(1, FOV)) == pytest.approx([*scene.CAMERA, *scene.LOOK_AT])
    camera, at = map(np.array, scene.view(count, FOV, aspect))
    assert camera[0] == at[0] == pytest.approx((scene.place(count - 1) + 1) / 2)
    ahead = (at - camera) / np.linalg.norm(at - camera)
    up = np.cross([1, 0, 0], ahead)
    for x in (0, scene.place(count - 1) + 1):
        for y in (0, 1):
            seen = np.array([x, y, 0]) - camera
            half = (seen @ ahead) * np.tan(FOV / 2)  # of the picture's height, at this distance
            assert abs(seen[0]) < half * aspect
            assert abs(seen @ up) < half


def test_the_export_is_one_page_with_every_fit(picture: road.Picture, store: Path) -> None:
    other = road.picture(RunReader(store / ROAD_MLE), 60)
    assert other is not None
    page = as_html([[picture, other], [picture, other]], "dark", ["TOM", "MLE"])
    data = re.search(r'__VISER_EMBED_DATA__="([^"]+)"', page)
    assert data is not None
    packed_scene = base64.b64decode(data[1])
    size = int.from_bytes(packed_scene[:8], "little")
    inner = zstandard.ZstdDecompressor().decompress(packed_scene[8:], max_output_size=size)
    length = int.from_bytes(inner[:8], "little")
    scene_of = msgspec.msgpack.decode(inner[8 : 8 + length])
    drive = (max(len(w) for w in picture.learnt) - 1) / STRIDE * FRAME_S
    assert scene_of["durationSeconds"] >= 2 * (drive + REST_S)
    names = {message.get("name") for _, message in scene_of["messages"]}
    assert {"/road0/weights", "/road1/weights", "/road0/learnt cars/0"} <= names
    assert {"/road0/title front", "/road0/title back", "/road1/goal/name back"} <= names
    assert not re.search(r'(?:src|href)="https?://', page)


@pytest.mark.parametrize("mode", ["light", "dark"])
def test_words_have_the_themes_colours_and_no_box_that_cuts_a_letter(mode: Mode) -> None:
    image = painted("TOM, fit of step 3,000, Äjgq|", mode)
    clear = np.equal(image[..., 3], 0)
    assert clear[[0, -1]].all()
    assert clear[:, [0, -1]].all()
    assert clear.mean() > 0.3
    letters = image[np.equal(image[..., 3], 255)]
    assert np.equal(letters, [*rgb(TEXT[mode]), 255]).all(1).mean() > 0.5
    halo = np.array(rgb(BACKGROUND[mode]))
    assert (np.abs(image[~clear, :3].astype(int) - halo) < 3).all(1).mean() > 0.2


@pytest.mark.parametrize("tilt", [0.0, 0.7, np.pi / 2])
def test_words_stand_on_their_foot_and_are_read_from_both_sides(
    server: viser.ViserServer, tilt: float
) -> None:
    across, high = extent("TOM s0", "dark", 0.05)
    assert across / high == pytest.approx(np.divide(*painted("TOM s0", "dark").shape[1::-1]))
    assert high > 0.05 * (painted("TOM s0", "dark").shape[0] - 20) / PIXELS
    foot = (0.5, 1.0, 0.02)
    front, back = add_words(server.scene, "/words", "TOM s0", "dark", foot, 0.05, tilt)
    turns = [viser.transforms.SO3(node.wxyz) for node in (front, back)]
    right, up, towards = ([turn.apply(np.eye(3)[axis]) for turn in turns] for axis in (0, 1, 2))
    assert towards[0] == pytest.approx([0, -np.sin(tilt), np.cos(tilt)])
    assert towards[1] == pytest.approx(-towards[0])
    assert up[0] == pytest.approx(up[1])  # upright from both sides
    assert right[0] == pytest.approx(-right[1])  # and no letter mirrored
    assert front.position - high / 2 * up[0] == pytest.approx(np.array(foot))
    assert back.position == pytest.approx(front.position)
    assert b'"doubleSided":true' not in front.glb_data + back.glb_data


@pytest.fixture
def told(tmp_path: Path) -> tuple[str, queue.Queue[tuple[str, Selection]]]:
    """A socket that is listened to, and what it is told; the page `deleted` cannot be shown."""
    path, told = str(tmp_path / "control"), queue.Queue()
    with socket.socket(socket.AF_UNIX) as killed:
        killed.bind(path)

    def select(page: str, selection: Selection) -> None:
        if page == "deleted":
            raise IndexError(page)
        told.put((page, selection))

    threading.Thread(target=listen, args=(path, select, lambda _: None), daemon=True).start()
    wait_for(lambda: answers(path))
    return path, told


def test_a_page_reaches_the_scene_server_and_messages_that_fail_do_not_end_it(
    told, caplog: pytest.LogCaptureFixture
) -> None:
    path, heard = told
    Client(path).close()  # as a page does that is killed before it has sent
    tell(path, "deleted", Selection(RoadChoice()))
    choices = (
        RoadChoice((ROAD_TOM,), 60),
        ReplayChoice("a", 1, 2, 3, 4, wish="play"),
        StatesChoice("a", (("heaviest", (1, 2), (2.5, 3.0)), ("lightest", (), ()))),
    )
    wanted = [("page", Selection(choice, "dark", compact=True)) for choice in choices]
    for page, selection in wanted:
        tell(path, page, selection)
    assert [heard.get(timeout=10) for _ in wanted] == wanted
    kinds = {type(record.exc_info[1]).__name__ for record in caplog.records if record.exc_info}
    assert kinds == {"EOFError", "IndexError"}


def test_a_server_that_is_not_there_is_an_os_error(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        tell(str(tmp_path / "none"), "page", Selection(RoadChoice()))
    with socket.socket(socket.AF_UNIX) as lone:
        lone.bind(str(tmp_path / "deaf"))
        with pytest.raises(ConnectionRefusedError):
            tell(str(tmp_path / "deaf"), "page", Selection(RoadChoice()))
