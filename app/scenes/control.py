"""The control socket between pages and the viser server, which only this user can open."""

import json
import logging
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from itertools import count
from multiprocessing.connection import Client, Connection, Listener
from pathlib import Path
from threading import Lock, Thread
from typing import Any, Literal

from app.theme import Mode

MESSAGE_LIMIT = 100_000
SILENCE_S = 30.0
"""seconds after which a silent client is dropped"""
ANSWER_S = 1.0
"""seconds that a page waits for an answer"""
PAUSE_S = 0.1
"""pause in seconds after a failed accept, so that a broken socket does not use a whole core"""

REAL_TIME = "real time"
SPEEDS = {"1/10": 0.1, "1/4": 0.25, "1/2": 0.5, REAL_TIME: 1.0, "2 times": 2.0, "4 times": 4.0}
"""choices of playback speed"""
CLOCK = "clock"
"""the kind of a message that asks for the clock"""
Wish = Literal["go", "play", "pause"]

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Clock:
    """The state of playback in a page's frame, after the page's request number `asked`."""

    frame: int
    playing: bool
    asked: int = 0


@dataclass(frozen=True)
class RoadChoice:
    """Fits of road-and-rocks runs side by side; by default of the newest run."""

    runs: tuple[str, ...] = ()
    step: int = -1


@dataclass(frozen=True)
class ReplayChoice:
    """An evaluation episode from `frame` on, with a ghost that restarts every `horizon` steps.

    `played` counts the page's requests to play it from the beginning, `asked` those of its `wish`:
    to play, to pause, or to go to `frame`. A higher count means a new request.
    """

    run: str
    step: int
    episode: int
    frame: int
    horizon: int
    played: int = 0
    asked: int = 0
    wish: Wish = "go"
    speed: str = REAL_TIME
    ghost: bool = True
    follow: bool = True


@dataclass(frozen=True)
class StatesChoice:
    """Robots in states of a run's replay buffer: two groups of rows, side by side."""

    run: str
    heavy: tuple[int, ...]  # numbers in the run's record
    light: tuple[int, ...]
    heavy_weights: tuple[float, ...]
    light_weights: tuple[float, ...]


Choice = RoadChoice | ReplayChoice | StatesChoice
KINDS: dict[str, type[Choice]] = {
    "road": RoadChoice,
    "replay": ReplayChoice,
    "states": StatesChoice,
}


@dataclass(frozen=True)
class Selection:
    """The content of one browser frame; in a `compact` one the panel is small and closed."""

    choice: Choice
    mode: Mode = "light"
    compact: bool = False


def tell(socket: str, client: str, selection: Selection) -> None:
    """Ask the viser server to show `selection` in the frame of `client`.

    Raises OSError if there is no server.
    """
    with Client(socket) as connection:
        connection.send_bytes(packed(client, selection))


def clock(socket: str, client: str) -> Clock | None:
    """The clock of the frame of `client`; None if nothing plays there.

    Raises OSError if there is no server, or it does not answer.
    """
    with Client(socket) as connection:
        connection.send_bytes(json.dumps({"client": client, "kind": CLOCK}).encode())
        if not connection.poll(ANSWER_S):
            raise TimeoutError("the scene server is busy")
        try:
            told = json.loads(connection.recv_bytes(MESSAGE_LIMIT))
        except EOFError as error:
            raise ConnectionError("the scene server has hung up") from error
    if not told:
        return None
    return Clock(int(told["frame"]), bool(told["playing"]), int(told["asked"]))


def listen(
    socket: str,
    select: Callable[[str, Selection], None],
    clock_of: Callable[[str], Clock | None] = lambda _: None,
) -> None:
    """Pass every arriving selection to `select`, one after another, forever.

    A request for a clock is answered with `clock_of`.

    Each client has a thread, so that a silent one does not block others. Of a page's selections the
    one that connected last counts. An incomplete or invalid message is logged, and later ones are
    still processed.
    """
    Path(socket).unlink(missing_ok=True)  # left by a killed server
    ear = _Ear(select, clock_of)
    with Listener(socket) as listener:
        for number in count():
            try:
                caller = listener.accept()
                Thread(target=ear.hear, args=(number, caller), daemon=True).start()
            except Exception:
                _log.exception("a page was not heard")
                time.sleep(PAUSE_S)


class _Ear:
    """Receives the messages of pages in threads."""

    def __init__(
        self,
        select: Callable[[str, Selection], None],
        clock_of: Callable[[str], Clock | None],
    ) -> None:
        self._select = select
        self._clock_of = clock_of
        self._newest: dict[str, int] = {}
        """by page, the number of the connection of its current selection"""
        self._turn = Lock()

    def hear(self, number: int, caller: Connection) -> None:
        """Read one message and show it, unless its page has sent a newer one."""
        try:
            with caller:
                if not caller.poll(SILENCE_S):
                    raise TimeoutError(f"nothing was said for {SILENCE_S:.0f} s")
                message = caller.recv_bytes(MESSAGE_LIMIT)
                if (what := json.loads(message))["kind"] == CLOCK:
                    told = self._clock_of(str(what["client"]))
                    caller.send_bytes(json.dumps(told and asdict(told)).encode())
                    return
                client, selection = unpacked(message)
                with self._turn:
                    if number > self._newest.get(client, -1):
                        self._newest[client] = number
                        self._select(client, selection)
        except Exception:
            with self._turn:  # Python 3.11 cannot format two tracebacks at a time
                _log.exception("a page's selection was not shown")


def packed(client: str, selection: Selection) -> bytes:
    """A selection as a message."""
    kind = next(name for name, made in KINDS.items() if isinstance(selection.choice, made))
    look = {"mode": selection.mode, "compact": selection.compact}
    what = {"client": client, "kind": kind, "choice": asdict(selection.choice)}
    return json.dumps(what | look).encode()


def unpacked(message: bytes) -> tuple[str, Selection]:
    """The client and the selection of a message."""
    what = json.loads(message)
    choice: dict[str, Any] = {
        name: tuple(value) if isinstance(value, list) else value
        for name, value in what["choice"].items()
    }
    shown = KINDS[what["kind"]](**choice)
    return str(what["client"]), Selection(shown, what["mode"], what["compact"])
