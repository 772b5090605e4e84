"""What a 3D frame shows, and the socket over which pages say so to the viser server.

Runs, and data sets that `tom weigh` keeps, are named by their folders.
Only this user can open the socket, so its messages are pickled objects of this module.
"""

import logging
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from multiprocessing.connection import Client, Listener
from pathlib import Path
from typing import Literal

from app.theme import Mode

START_S = 3.0
"""seconds that a page waits for the 3D server to start"""
ANSWER_S = 1.0
"""seconds that a page waits for an answer"""
REAL_TIME = "real time"
SPEEDS = {"1/10": 0.1, "1/4": 0.25, "1/2": 0.5, REAL_TIME: 1.0, "2 times": 2.0, "4 times": 4.0}
"""choices of playback speed"""
Command = Literal["go", "play", "pause", "start"]
"""go to a frame, play on, pause, or play from the beginning"""

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Clock:
    """The state of playback in a page's frame, after the page's request number `request`."""

    frame: int
    playing: bool
    request: int = 0


@dataclass(frozen=True)
class RoadChoice:
    """Road-and-rocks runs side by side, each at its last fit up to `step`."""

    runs: tuple[str, ...] = ()
    step: int = -1


@dataclass(frozen=True)
class ReplayChoice:
    """An evaluation episode, first shown at `frame`, with a ghost that restarts every `horizon`.

    `request` counts the page's requests: a higher count means that its `command` is a new one.
    """

    run: str
    step: int
    episode: int
    frame: int
    horizon: int
    request: int = 0
    command: Command = "go"
    speed: str = REAL_TIME
    ghost: bool = True
    follow: bool = True


@dataclass(frozen=True)
class StatesChoice:
    """Robots in states of a replay buffer: two groups of rows, side by side.

    Each group has a title, the rows' numbers in the run's record, and their weights.
    """

    run: str
    groups: tuple[tuple[str, tuple[int, ...], tuple[float, ...]], ...]


Choice = RoadChoice | ReplayChoice | StatesChoice


@dataclass(frozen=True)
class Selection:
    """The content of one browser frame."""

    choice: Choice
    mode: Mode = "light"


def send_selection(socket: str, page: str, selection: Selection) -> None:
    """Ask the viser server to show `selection` in the frame of `page`.

    Waits for a server that starts. Raises OSError if there is none.
    """
    until = time.monotonic() + START_S
    while not Path(socket).exists() and time.monotonic() < until:
        time.sleep(0.05)
    with Client(socket) as server:
        server.send((page, selection))


def clock(socket: str, page: str) -> Clock | None:
    """The clock of the frame of `page`; None if nothing plays there.

    Raises OSError if there is no server, or it does not answer.
    """
    with Client(socket) as server:
        server.send((page, None))
        if not server.poll(ANSWER_S):
            raise TimeoutError("the scene server is busy")
        try:
            return server.recv()
        except EOFError as error:
            raise ConnectionError("the scene server has hung up") from error


def listen(
    socket: str,
    select: Callable[[str, Selection], None],
    clock_of: Callable[[str], Clock | None],
) -> None:
    """Pass arriving selections to `select`, in their order, and answer with `clock_of`, forever.

    Selections are shown in a thread, so that a scene that takes long to draw delays no answer. A
    message that fails is logged.
    """

    def failed(shown: Future[None]) -> None:
        if error := shown.exception():
            _log.error("a page's selection was not shown", exc_info=error)

    Path(socket).unlink(missing_ok=True)  # left by a killed server
    with Listener(socket) as listener, ThreadPoolExecutor(1) as scenes:
        while True:
            try:
                with listener.accept() as caller:
                    page, selection = caller.recv()
                    if selection is None:
                        caller.send(clock_of(page))
                    else:
                        scenes.submit(select, page, selection).add_done_callback(failed)
            except (OSError, EOFError):  # the page was closed meanwhile
                _log.exception("a page was not heard")
