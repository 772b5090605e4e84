"""The 3D scene: what is drawn, with its words, and that a frame shows what its page chose."""

import base64
import queue
import re
import socket
from multiprocessing.connection import Client
from pathlib import Path

import msgspec
import numpy as np
import pytest
import zstandard
from common import present
from studio_pages import hear
from studio_runs import ROAD_MLE, ROAD_TOM

from app.data import road
from app.data.road import CELLS, on_road
from app.scenes import road as scene
from app.scenes.control import (
    ReplayChoice,
    RoadChoice,
    Selection,
    StatesChoice,
    send_selection,
)
from app.scenes.road import FRAME_S, REST_S, STRIDE, as_html
from tom.record.reader import RunReader


@pytest.fixture(scope="module")
def picture(store: Path) -> road.Picture:
    return present(road.picture(RunReader(store / ROAD_TOM), 60))


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


def test_the_export_is_one_page_with_every_fit(picture: road.Picture, store: Path) -> None:
    other = present(road.picture(RunReader(store / ROAD_MLE), 60))
    page = as_html([[picture, other], [picture, other]], "dark", ["TOM", "MLE"])
    data = present(re.search(r'__VISER_EMBED_DATA__="([^"]+)"', page))
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

    hear(path, select)
    return path, told


def test_a_page_reaches_the_scene_server_and_messages_that_fail_do_not_end_it(
    told, caplog: pytest.LogCaptureFixture
) -> None:
    path, heard = told
    Client(path).close()  # as a page does that is killed before it has sent
    send_selection(path, "deleted", Selection(RoadChoice()))
    choices = (
        RoadChoice((ROAD_TOM,), 60),
        ReplayChoice("a", 1, 2, 3, 4, command="play"),
        StatesChoice("a", (("heaviest", (1, 2), (2.5, 3.0)), ("lightest", (), ()))),
    )
    wanted = [("page", Selection(choice, "dark")) for choice in choices]
    for page, selection in wanted:
        send_selection(path, page, selection)
    assert [heard.get(timeout=10) for _ in wanted] == wanted
    kinds = {type(record.exc_info[1]).__name__ for record in caplog.records if record.exc_info}
    assert kinds == {"EOFError", "IndexError"}
