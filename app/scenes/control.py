"""How a page tells the viser server what to show: a socket that only this user can open."""

import json
import logging
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from itertools import count
from multiprocessing.connection import Client, Connection, Listener
from pathlib import Path
from threading import Lock, Thread
from typing import Any

from app.theme import Mode

MESSAGE_LIMIT = 100_000
SILENCE_S = 30.0
"""a client that has said nothing for so long is given up"""
PAUSE_S = 0.1
"""after a client that could not be let in: a socket that fails must not keep a core busy"""

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class RoadChoice:
    """Fits of road-and-rocks runs side by side; no run means the newest."""

    runs: tuple[str, ...] = ()
    step: int = -1


@dataclass(frozen=True)
class ReplayChoice:
    """An evaluation episode from `frame` on, its ghost starting again every `horizon` steps.

    `played` counts how often the page has asked for it to be played from its beginning.
    """

    run: str
    step: int
    episode: int
    frame: int
    horizon: int
    played: int = 0


@dataclass(frozen=True)
class StatesChoice:
    """Robots in states of a run's replay buffer: two groups of its rows, side by side."""

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
    """What one browser frame is to show; in a `compact` one the panel is small and folded up."""

    choice: Choice
    mode: Mode = "light"
    compact: bool = False


def tell(socket: str, client: str, selection: Selection) -> None:
    """Ask the viser server to show `selection` in the frame of `client`.

    Raises OSError when the server is not there.
    """
    with Client(socket) as connection:
        connection.send_bytes(packed(client, selection))


def listen(socket: str, select: Callable[[str, Selection], None]) -> None:
    """Hand every selection that arrives to `select`, one after the other, for ever.

    Each client is heard beside the others, so one that never sends holds up nobody. Of a page's
    selections the one counts that connected last. A message that breaks off, or that cannot be
    shown, is logged: those after it still count.
    """
    Path(socket).unlink(missing_ok=True)  # what a server that was killed left behind
    ear = _Ear(select)
    with Listener(socket) as listener:
        for number in count():
            try:
                caller = listener.accept()
                Thread(target=ear.hear, args=(number, caller), daemon=True).start()
            except Exception:
                _log.exception("a page was not heard")
                time.sleep(PAUSE_S)


class _Ear:
    """What pages have said, whichever of them says it first."""

    def __init__(self, select: Callable[[str, Selection], None]) -> None:
        self._select = select
        self._newest: dict[str, int] = {}
        """the number of the connection that brought what a page shows"""
        self._turn = Lock()

    def hear(self, number: int, caller: Connection) -> None:
        """Read one message and show it, unless its page has said something newer."""
        try:
            with caller:
                if not caller.poll(SILENCE_S):
                    raise TimeoutError(f"nothing was said for {SILENCE_S:.0f} s")
                client, selection = unpacked(caller.recv_bytes(MESSAGE_LIMIT))
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
