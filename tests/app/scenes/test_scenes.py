"""The 3D scene: what is drawn, and that a frame shows what its page chose."""

import base64
import os
import re
import socket
import threading
import time
from collections.abc import Iterator
from multiprocessing.connection import Client
from pathlib import Path

import msgspec
import numpy as np
import pytest
import viser
import zstandard
from studio_runs import ROAD_MLE, ROAD_TOM

from app.data import road
from app.data.road import CELLS, on_road
from app.scenes import arrays, solids
from app.scenes import road as scene
from app.scenes.control import (
    ReplayChoice,
    RoadChoice,
    Selection,
    StatesChoice,
    listen,
    packed,
    tell,
    unpacked,
)
from app.scenes.export import FRAME_S, REST_S, STRIDE, as_html
from app.scenes.road import RoadScene
from app.scenes.road_frame import LAYERS
from app.servers.processes import free_port
from tom.record.reader import RunReader

FOV = float(np.radians(75))
"""viser's own field of view"""


@pytest.fixture(scope="module")
def picture(store: Path) -> road.Picture:
    found = road.picture(RunReader(store / ROAD_TOM), 60)
    assert found is not None
    return found


def test_a_cell_with_weight_is_a_column(picture: road.Picture) -> None:
    columns = arrays.columns(picture.grid, "light")
    heavy = np.nan_to_num(picture.grid) >= 1 / 16
    assert len(columns.position) == heavy.sum() > 100
    i = int(np.argmax(columns.scale[:, 2]))
    x, y = (columns.position[i, :2] * CELLS).astype(int)
    assert picture.grid[y, x] >= 16 or picture.grid[y, x] == np.nanmax(picture.grid)
    assert columns.position[:, 2] == pytest.approx(columns.scale[:, 2] / 2)
    assert columns.scale[:, 2].max() <= arrays.TALLEST + 1e-6


def test_toms_columns_stand_on_the_road(picture: road.Picture) -> None:
    columns = arrays.columns(picture.grid, "light")
    tall = columns.scale[:, 2] > arrays.TALLEST / 2
    assert on_road(columns.position[tall, :2], picture.road).mean() > 0.9


def test_height_and_colour_grow_with_the_weight() -> None:
    grid = np.full((CELLS, CELLS), np.nan)
    grid[0, :4] = [0.01, 1, 4, 100]
    columns = arrays.columns(grid, "light")
    assert len(columns.scale) == 3
    assert columns.scale[:, 2] == pytest.approx(arrays.TALLEST * np.array([0.25, 0.5, 1]))
    assert columns.colour[2].tolist() == [194, 44, 6]


def test_stones_lie_beside_the_road(picture: road.Picture) -> None:
    position, size = arrays.boulders(picture.road)
    assert len(position) == len(size) > 100
    assert not on_road(position[:, :2], picture.road).any()


def test_arrows_point_where_the_model_says(picture: road.Picture) -> None:
    found = arrays.arrows(picture.points, picture.modelled, 0.1)
    assert found[:, 1, :2] - found[:, 0, :2] == pytest.approx(picture.modelled, abs=1e-6)
    assert (found[..., 2] == np.float32(0.1)).all()


def test_lines_become_segments() -> None:
    line = np.array([[0, 0], [1, 0], [1, 1]])
    assert arrays.segments([line, line[:1]], 0.5).tolist() == [
        [[0, 0, 0.5], [1, 0, 0.5]],
        [[1, 0, 0.5], [1, 1, 0.5]],
    ]
    assert arrays.segments([], 0).shape == (0, 2, 3)


@pytest.fixture
def server() -> Iterator[viser.ViserServer]:
    made = viser.ViserServer("127.0.0.1", free_port("127.0.0.1"), verbose=False)
    yield made
    made.stop()


def test_a_fit_takes_the_place_of_another(
    server: viser.ViserServer, picture: road.Picture, store: Path
) -> None:
    drawn = RoadScene(server.scene, picture, "light")
    before = drawn.layers["columns"][0]
    other = road.picture(RunReader(store / ROAD_MLE), 60)
    assert other is not None
    drawn.update(other)
    assert drawn.layers["columns"][0] is not before
    assert set(drawn.layers) == {name for name, _, _ in LAYERS}
    drawn.show({"columns": False, "flat": True, "cars": False})
    assert not drawn.layers["columns"][0].visible
    assert drawn.layers["flat"][0].visible
    assert not any(fleet.visible for fleet in drawn.cars)


def test_maps_stand_side_by_side() -> None:
    assert scene.place(0) == 0
    assert scene.place(1) > 1


def test_one_map_is_seen_as_the_camera_of_all_scenes_has_it() -> None:
    camera, at = scene.view(1, FOV)
    assert camera == pytest.approx(scene.CAMERA)
    assert at == pytest.approx(scene.LOOK_AT)


@pytest.mark.parametrize("aspect", [0.6, 1.0, 16 / 9, 3.0])
@pytest.mark.parametrize("count", [1, 2, 3, 4])
def test_every_map_is_in_the_picture_however_wide_it_is(count: int, aspect: float) -> None:
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


def test_cars_drive_the_recorded_ways(picture: road.Picture) -> None:
    way = picture.learnt[0]
    car = solids.car(way, 0.1)
    assert car.position[:, 0, :2] == pytest.approx(way, abs=1e-6)
    assert (car.position[..., 2] > 0.1).all()


def test_the_flat_picture_is_clear_where_nothing_was_recorded() -> None:
    grid = np.full((CELLS, CELLS), np.nan)
    grid[0, 3] = 100
    flat = arrays.flat(grid, "light")
    assert flat[0, 3].tolist() == [194, 44, 6, 235]
    assert flat[..., 3].sum() == 235


def test_the_export_is_one_page_with_every_fit(picture: road.Picture, store: Path) -> None:
    other = road.picture(RunReader(store / ROAD_MLE), 60)
    assert other is not None
    page = as_html([[picture, other], [picture, other]], "dark")
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
    assert {"/road0/weights", "/road1/weights", "/road0/learnt cars/0", "/road1/goal/name"} <= names
    assert {"/road0/title front", "/road0/title back", "/road1/goal/name back"} <= names
    assert not re.search(r'(?:src|href)="https?://', page)


def test_a_page_reaches_the_scene_server(tmp_path: Path) -> None:
    heard: list[tuple[str, Selection]] = []
    arrived = threading.Event()

    def select(client: str, selection: Selection) -> None:
        heard.append((client, selection))
        arrived.set()

    path = str(tmp_path / "control")
    with socket.socket(socket.AF_UNIX) as killed:
        killed.bind(path)
    threading.Thread(target=listen, args=(path, select), daemon=True).start()
    wanted = Selection(RoadChoice((ROAD_TOM,), 60), "dark")
    for _ in range(100):
        try:
            tell(path, "page", wanted)
            break
        except OSError:
            arrived.wait(0.05)
    assert arrived.wait(10)
    assert heard == [("page", wanted)]


def closed_unsent(path: str) -> bool:
    """As a page does that is killed before it has sent; False while nobody listens."""
    try:
        Client(path).close()
    except OSError:
        return False
    return True


def test_messages_that_fail_do_not_end_the_listening(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    got: list[Selection] = []
    shown = threading.Event()

    def select(client: str, selection: Selection) -> None:
        if client == "rewound":
            raise IndexError(client)
        got.append(selection)
        shown.set()

    path = str(tmp_path / "control")
    threading.Thread(target=listen, args=(path, select), daemon=True).start()
    until = time.monotonic() + 10
    while not closed_unsent(path) and time.monotonic() < until:
        time.sleep(0.02)
    with Client(path) as broken:
        broken.send_bytes(b"{")
    tell(path, "rewound", Selection(RoadChoice()))
    tell(path, "page", Selection(RoadChoice(step=3)))
    assert shown.wait(10)
    assert got == [Selection(RoadChoice(step=3))]
    while len(caplog.records) < 3 and time.monotonic() < until + 10:
        time.sleep(0.02)
    kinds = [type(record.exc_info[1]).__name__ for record in caplog.records if record.exc_info]
    assert sorted(kinds) == ["EOFError", "IndexError", "JSONDecodeError"]


def heard(path: str) -> tuple[list[Selection], threading.Event]:
    """What is shown from now on, and that something was, of what `path` is told."""
    got: list[Selection] = []
    shown = threading.Event()

    def select(_: str, selection: Selection) -> None:
        got.append(selection)
        shown.set()

    threading.Thread(target=listen, args=(path, select), daemon=True).start()
    until = time.monotonic() + 10
    while not closed_unsent(path) and time.monotonic() < until:
        time.sleep(0.02)
    return got, shown


@pytest.mark.parametrize("said", [b"", b"\0\0"], ids=["silent", "broken off"])
def test_a_client_that_does_not_finish_holds_up_nobody(tmp_path: Path, said: bytes) -> None:
    path = str(tmp_path / "control")
    got, shown = heard(path)
    with Client(path) as halting:
        os.write(halting.fileno(), said)
        tell(path, "page", Selection(RoadChoice(step=3)))
        assert shown.wait(10)
    assert got == [Selection(RoadChoice(step=3))]


def test_of_two_selections_of_a_page_the_later_connection_counts(tmp_path: Path) -> None:
    path = str(tmp_path / "control")
    got, shown = heard(path)
    with Client(path) as late:
        tell(path, "page", Selection(RoadChoice(step=2)))
        assert shown.wait(10)
        late.send_bytes(packed("page", Selection(RoadChoice(step=1))))
        with pytest.raises(EOFError):  # it was heard to its end
            late.recv_bytes()
    assert got == [Selection(RoadChoice(step=2))]


@pytest.mark.parametrize(
    "choice",
    [
        RoadChoice(("a", "b"), 3),
        ReplayChoice("a", 1, 2, 3, 4),
        StatesChoice("a", (1, 2), (), (2.5, 3.0), ()),
    ],
)
def test_a_message_says_what_was_chosen(choice: RoadChoice | ReplayChoice | StatesChoice) -> None:
    selection = Selection(choice, "dark", compact=True)
    assert unpacked(packed("page", selection)) == ("page", selection)


def test_a_server_that_is_not_there_is_an_os_error(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        tell(str(tmp_path / "none"), "page", Selection(RoadChoice()))
    with socket.socket(socket.AF_UNIX) as lone:
        lone.bind(str(tmp_path / "deaf"))
        with pytest.raises(ConnectionRefusedError):
            tell(str(tmp_path / "deaf"), "page", Selection(RoadChoice()))
