"""The viser server's process: one scene per browser frame, controlled by the pages."""

import gzip
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from http import HTTPStatus
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

import viser
from websockets.asyncio import server
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

from app.links import Links
from app.scenes.control import (
    Choice,
    Clock,
    ReplayChoice,
    RoadChoice,
    Selection,
    StatesChoice,
    listen,
)
from app.theme import BACKGROUND, Mode
from tom import plugins
from tom.errors import UserError
from tom.machine.address import framing, refusal

if TYPE_CHECKING:
    from app.scenes.frame import Frame

Answer = Callable[[ServerConnection, Request], Response | None]

TICK_S = 1 / 30


class SceneServer:
    """The frames, by the name of the page that embeds them."""

    def __init__(self, links: Links) -> None:
        self.links = links
        self.chosen: dict[str, Selection] = {}
        self.begun: dict[str, int] = {}
        """by page, how often its episode was played from the beginning"""
        self.frames: dict[int, tuple[str, Frame]] = {}
        with guarded(links):
            self.server = viser.ViserServer(links.host, links.viser_port, verbose=False)
        if self.server.get_port() != links.viser_port:  # viser silently takes the next port
            raise SystemExit(f"port {links.viser_port} is taken")
        self.server.scene.set_up_direction("+z")
        self.server.on_client_connect(self._connected)
        self.server.on_client_disconnect(self._left)

    def select(self, client: str, selection: Selection) -> None:
        """Store a page's selection and show it in its frames."""
        before = self.chosen.get(client)
        self.chosen[client] = selection
        if before == selection:
            return
        frames = list(self.frames.items())
        here = [(number, frame) for number, (name, frame) in frames if name == client]
        play = bool(here) and self._asked_to_play(client, selection.choice)
        for number, frame in here:
            self._show(number, client, frame, selection, play=play)

    def clock(self, client: str) -> Clock | None:
        """The clock of a page's frame; None if nothing plays there."""
        frames = [frame for _, (name, frame) in list(self.frames.items()) if name == client]
        clocks = [clock for frame in frames if (clock := frame.clock())]
        return clocks[-1] if clocks else None

    def tick(self, seconds: float) -> None:
        """Advance all frames by `seconds`."""
        for _, frame in list(self.frames.values()):
            frame.tick(seconds)

    def _asked_to_play(self, name: str, choice: Choice) -> bool:
        """Whether the page has requested playback since the last start, which is then counted.

        So a request waits for the page's first frame, and a reconnected frame does not play again.
        """
        asked = choice.played if isinstance(choice, ReplayChoice) else 0
        begun, self.begun[name] = self.begun.get(name, 0), asked
        return asked > begun

    def _show(
        self, number: int, name: str, frame: "Frame", selection: Selection, *, play: bool
    ) -> None:
        if type(frame) is not frame_class(selection.choice):
            frame.close()
            frame = self._frame(frame.client, selection)
            if not self._insert(number, name, frame):
                return
        try:
            frame.show(selection, play=play)
        except UserError as error:  # deleted or damaged meanwhile; the last picture stays
            frame.client.add_notification("Not shown", str(error), auto_close_seconds=8)

    def _connected(self, client: viser.ClientHandle) -> None:
        request = self._request(client)
        if request is None:  # already disconnected
            return
        name = request.path.strip("/")
        selection = self.chosen.get(name, Selection(RoadChoice(), self.links.theme or "light"))
        frame = self._frame(client, selection)
        if not self._insert(client.client_id, name, frame):
            return
        selection = self.chosen.get(name, selection)  # it may have changed while this was built
        play = self._asked_to_play(name, selection.choice)
        self._show(client.client_id, name, frame, selection, play=play)

    def _insert(self, number: int, name: str, frame: "Frame") -> bool:
        """Store a frame; returns False if its tab was closed while it was built (see `_left`)."""
        self.frames[number] = (name, frame)
        if number in self.server.get_clients():
            return True
        self.frames.pop(number, None)
        return False

    def _frame(self, client: viser.ClientHandle, selection: Selection) -> "Frame":
        kind = frame_class(selection.choice)
        return kind(client, self.links.store, selection.mode, compact=selection.compact)

    def _left(self, client: viser.ClientHandle) -> None:
        self.frames.pop(client.client_id, None)

    def _request(self, client: viser.ClientHandle) -> Request | None:
        # viser has no public attribute for a client's request; its path is the only thing that a
        # page can set (`?websocket=` in Links.viser).
        return self.server._websock_server._live_connections[client.client_id].request


def frame_class(choice: Choice) -> "type[Frame]":
    """What shows a choice; imported when a page first asks for it, since a robot needs MuJoCo."""
    match choice:
        case RoadChoice():
            from app.scenes.road_frame import RoadFrame

            return RoadFrame
        case ReplayChoice():
            from app.scenes.replay_frame import ReplayFrame

            return ReplayFrame
        case StatesChoice():
            from app.scenes.states_frame import StatesFrame

            return StatesFrame


@contextmanager
def guarded(links: Links) -> Iterator[None]:
    """Websocket servers started inside the block answer only the studio's own pages.

    viser itself answers every page in a browser and has no option against this.
    """
    serve = server.serve

    def guarded_serve(*arguments: Any, process_request: Answer, **options: Any) -> server.serve:
        first = partial(_admit, links, process_request)
        return serve(*arguments, process_request=first, **options)

    server.serve = guarded_serve  # pyright: ignore[reportAttributeAccessIssue]
    try:
        yield
    finally:
        server.serve = serve


def _admit(
    links: Links, answer: Answer, connection: ServerConnection, request: Request
) -> Response | None:
    """viser's answer to a request, or a refusal; only the studio's pages may embed it."""
    if why := refusal(request.headers.get, links.host, links.viser_port):
        return connection.respond(HTTPStatus.FORBIDDEN, why)
    answered = answer(connection, request)
    if answered is not None:
        answered.headers["Content-Security-Policy"] = framing(links.host, links.port)
        if urlsplit(request.path).path == "/" and answered.status_code == HTTPStatus.OK:
            _dress(answered, "dark" if "darkMode" in request.path else "light")
    return answered


def _dress(page: Response, mode: Mode) -> None:
    """Give viser's page the studio's background at once, because its script takes a second."""
    packed = page.headers.get("Content-Encoding") == "gzip"
    html = gzip.decompress(page.body) if packed else page.body
    style = f"<head><style>html {{ background: {BACKGROUND[mode]} }}</style>".encode()
    html = html.replace(b"<head>", style, 1)
    page.body = gzip.compress(html, 1) if packed else html
    if "Content-Length" in page.headers:
        del page.headers["Content-Length"]
        page.headers["Content-Length"] = str(len(page.body))


def main() -> None:
    """Serve until SIGTERM."""
    plugins.load()
    links = Links.from_environment()
    served = SceneServer(links)
    threading.Thread(
        target=listen, args=(links.control, served.select, served.clock), daemon=True
    ).start()
    then = time.monotonic()
    while True:
        time.sleep(TICK_S)
        now = time.monotonic()
        served.tick(now - then)
        then = now


if __name__ == "__main__":
    main()
