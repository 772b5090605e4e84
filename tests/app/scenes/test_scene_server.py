"""The viser server's process: frames that connect, and what they then do."""

import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import viser
from common import present
from kernel import wait_for
from studio_runs import PENDULUM_TOM, ROAD_TOM
from viser import _messages
from viser.transforms import SO3
from websockets.sync.client import ClientConnection, unix_connect
from websockets.typing import Subprotocol

from app.data.buffer import WINDOW
from app.links import Links
from app.scenes import server
from app.scenes.control import (
    Clock,
    Command,
    ReplayChoice,
    RoadChoice,
    Selection,
    StatesChoice,
)
from app.scenes.frame import Frame
from app.scenes.replay import ReplayFrame
from app.scenes.road import PLAY_S, RoadFrame
from app.scenes.server import SceneServer
from app.scenes.states import StatesFrame
from app.theme import Mode
from tom.record.reader import RunReader

CAMERA = _messages.ViewerCameraMessage(
    wxyz=(1.0, 0.0, 0.0, 0.0),
    position=(0.0, -1.0, 1.0),
    fov=1.0,
    near=0.1,
    far=100.0,
    image_height=100,
    image_width=100,
    look_at=(0.0, 0.0, 0.0),
    up_direction=(0.0, 0.0, 1.0),
)
PAGE = "page"


@pytest.fixture
def served(tmp_path: Path) -> Iterator[SceneServer]:
    made = SceneServer(Links(folder=str(tmp_path)))
    yield made
    made.server.stop()


def frame_of_a_page(served: SceneServer, aspect: float = 1) -> ClientConnection:
    """A browser frame, as viser's own client opens it: it says where its camera stands."""
    camera = replace(CAMERA, image_width=round(aspect * CAMERA.image_height))
    opened = unix_connect(
        str(served.links.file("scenes")),
        f"ws://scenes/{PAGE}",
        subprotocols=[Subprotocol(f"viser-v{viser.__version__}")],
        max_size=None,
        max_queue=None,
    )
    opened.send(msgspec.msgpack.encode(camera.as_serializable_dict()))
    return opened


def only_frame(served: SceneServer, kind: type[Frame] = ReplayFrame) -> Any:
    frames = [frame for _, frame in served.frames.values()]
    return frames[0] if len(frames) == 1 and isinstance(frames[0], kind) else None


def asked(run: Path, times: int) -> Selection:
    return Selection(ReplayChoice(str(run), 400, 0, 0, 25, times, "start"))


def test_what_was_to_play_before_its_frame_connected_plays_then(
    served: SceneServer, store: Path
) -> None:
    run = store / PENDULUM_TOM
    served.select(PAGE, asked(run, 0))
    served.select(PAGE, asked(run, 1))
    with frame_of_a_page(served):
        wait_for(lambda: (frame := only_frame(served)) is not None and frame.playing)
    wait_for(lambda: not served.frames)
    with frame_of_a_page(served):  # the reader comes back: it has been played
        wait_for(lambda: (frame := only_frame(served)) is not None and frame.frame.max > 1)
        frame = only_frame(served)
        assert frame is not None
        frame.tick(0.0)  # waits until the frame has shown everything
        assert not frame.playing
        served.select(PAGE, asked(run, 2))
        assert frame.playing


def test_a_page_plays_pauses_and_asks_where_its_episode_is(
    served: SceneServer, store: Path
) -> None:
    run = str(store / PENDULUM_TOM)

    def wish(asked: int, wish: Command, frame: int) -> Selection:
        return Selection(ReplayChoice(run, 400, 0, frame, 25, request=asked, command=wish))

    assert served.clock(PAGE) is None
    served.select(PAGE, wish(0, "go", 3))
    with frame_of_a_page(served):
        wait_for(lambda: served.clock(PAGE) == Clock(3, playing=False))
        served.select(PAGE, wish(1, "play", 3))
        served.tick(2 * only_frame(served)._replay.dt)
        assert served.clock(PAGE) == Clock(5, playing=True, request=1)
        served.select(PAGE, wish(2, "pause", 5))
        assert served.clock(PAGE) == Clock(5, playing=False, request=2)
        served.select(PAGE, wish(3, "go", 3))  # once more to where it was sent before
        assert served.clock(PAGE) == Clock(3, playing=False, request=3)


@pytest.mark.parametrize("aspect", [1, 1.5, 4])
def test_a_frame_of_any_width_has_all_robots_in_its_picture(
    served: SceneServer, store: Path, aspect: float
) -> None:
    group = tuple(range(0, 180, 20)), (1.0,) * 9
    choice = StatesChoice(str(store / PENDULUM_TOM), (("heaviest", *group), ("lightest", *group)))
    served.select(PAGE, Selection(choice))
    with frame_of_a_page(served, aspect):
        wait_for(lambda: (frame := only_frame(served, StatesFrame)) and frame._drawn)
        frame = present(only_frame(served, StatesFrame))
        camera = frame.client.camera
        seen = [
            (robot._position[:, WINDOW] + place - camera.position) @ SO3(camera.wxyz).as_matrix()
            for robot, place in frame._robots
        ]
        across, down, ahead = np.concatenate(seen).reshape(-1, 3).T
        half = ahead * np.tan(camera.fov / 2)
        assert (np.abs(across) < aspect * half).all()
        assert (np.abs(down) < half).all()


def test_after_the_fits_have_played_the_timelines_is_shown(
    served: SceneServer, store: Path
) -> None:
    first, last = RunReader(store / ROAD_TOM).snapshot_steps()[-2:]
    served.select(PAGE, Selection(RoadChoice((str(store / ROAD_TOM),), first)))
    with frame_of_a_page(served):
        wait_for(lambda: (frame := only_frame(served, RoadFrame)) and frame._drawn)
        frame = present(only_frame(served, RoadFrame))
        frame.play.value = True
        frame.tick(PLAY_S)
        assert frame._drawn == [(ROAD_TOM, last)]
        frame.play.value = False
        wait_for(lambda: frame._drawn == [(ROAD_TOM, first)], 10)


def test_a_tab_left_while_its_frame_is_built_leaves_none(
    served: SceneServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    find, built, found = served._frame_of, threading.Event(), []

    def slow(client: viser.ClientHandle, mode: Mode) -> Frame:
        frame = RoadFrame(client, mode)
        built.set()
        wait_for(lambda: not served.server.get_clients())
        return frame

    monkeypatch.setattr(server, "frame_class", lambda _: slow)
    monkeypatch.setattr(served, "_frame_of", lambda *of: found.append(find(*of)) or found[-1])
    with frame_of_a_page(served):
        assert built.wait(60)
    wait_for(lambda: found)
    assert (found, served.frames) == ([None], {})
