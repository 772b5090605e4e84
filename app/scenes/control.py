"""How a page tells the viser server what to show: a socket that only this user can open."""

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass
from multiprocessing.connection import Client, Listener
from pathlib import Path

from app.theme import Mode

MESSAGE_LIMIT = 10_000


@dataclass(frozen=True)
class Selection:
    """What one browser frame is to show; an empty run means the newest."""

    run: str = ""
    step: int = -1
    mode: Mode = "light"


def tell(socket: str, client: str, selection: Selection) -> None:
    """Ask the viser server to show `selection` in the frame of `client`.

    Raises OSError when the server is not there.
    """
    with Client(socket) as connection:
        connection.send_bytes(json.dumps({"client": client, **asdict(selection)}).encode())


def listen(socket: str, select: Callable[[str, Selection], None]) -> None:
    """Hand every selection that arrives to `select`, for ever."""
    Path(socket).unlink(missing_ok=True)  # what a server that was killed left behind
    with Listener(socket) as listener:
        while True:
            with listener.accept() as connection:
                message = json.loads(connection.recv_bytes(MESSAGE_LIMIT))
            select(str(message.pop("client")), Selection(**message))
