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
from app.scenes.control import Choice, Clock, ReplayChoice, RoadChoice, Selection, listen
from app.theme import BACKGROUND
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
        self.heard: dict[str, int] = {}
        """by page, its last request that a frame has carried out"""
        self.frames: dict[int, tuple[str, Frame]] = {}
        with guarded(links):
            self.server = viser.ViserServer(links.host, links.viser_port, verbose=False)
        if self.server.get_port() != links.viser_port:  # viser silently takes the next port
            raise SystemExit(f"port {links.viser_port} is taken")
        self.server.scene.set_up_direction("+z")
        self.server.on_client_connect(self._connected)
        self.server.on_client_disconnect(self._left)

    def select(self, page: str, selection: Selection) -> None:
        """Store a page's selection and show it in its frames."""
        before, self.chosen[page] = self.chosen.get(page), selection
        if before == selection:
            return
        here = [item for item in list(self.frames.items()) if item[1][0] == page]
        obey = bool(here) and self._asks_anew(page, selection.choice)
        for number, (_, frame) in here:
            self._show(number, page, frame, selection, obey=obey)

    def clock(self, page: str) -> Clock | None:
        """The clock of a page's frame; None if nothing plays there."""
        frames = [frame for _, (name, frame) in list(self.frames.items()) if name == page]
        return next((clock for frame in reversed(frames) if (clock := frame.clock())), None)

    def tick(self, seconds: float) -> None:
        """Advance all frames by `seconds`."""
        for _, frame in list(self.frames.values()):
            frame.tick(seconds)

    def _asks_anew(self, page: str, choice: Choice) -> bool:
        """Whether the choice has a request that no frame of the page has carried out; now one will.

        So a request waits for the page's first frame, and a reconnected frame does not repeat it.
        """
        asked = choice.asked if isinstance(choice, ReplayChoice) else 0
        heard, self.heard[page] = self.heard.get(page, 0), asked
        return asked > heard

    def _show(
        self, number: int, page: str, frame: "Frame", selection: Selection, *, obey: bool
    ) -> None:
        if type(frame) is not frame_class(selection.choice):
            frame.close()
            frame = self._frame(frame.client, selection)
            if not self._insert(number, page, frame):
                return
        try:
            frame.show(selection, obey=obey)
        except UserError as error:  # deleted or damaged meanwhile; the last picture stays
            frame.client.add_notification("Not shown", str(error), auto_close_seconds=8)

    def _connected(self, client: viser.ClientHandle) -> None:
        # viser has no public attribute for a client's request; its path is the only thing that a
        # page can set (`?websocket=` in Links.viser).
        request = self.server._websock_server._live_connections[client.client_id].request
        if request is None:  # already disconnected
            return
        page = request.path.strip("/")
        selection = self.chosen.get(page, Selection(RoadChoice(), self.links.theme or "light"))
        frame = self._frame(client, selection)
        if not self._insert(client.client_id, page, frame):
            return
        selection = self.chosen.get(page, selection)  # it may have changed while this was built
        obey = self._asks_anew(page, selection.choice)
        self._show(client.client_id, page, frame, selection, obey=obey)

    def _insert(self, number: int, page: str, frame: "Frame") -> bool:
        """Store a frame; returns False if its tab was closed while it was built (see `_left`)."""
        self.frames[number] = (page, frame)
        if number in self.server.get_clients():
            return True
        self.frames.pop(number, None)
        return False

    def _frame(self, client: viser.ClientHandle, selection: Selection) -> "Frame":
        kind = frame_class(selection.choice)
        return kind(client, self.links.store, selection.mode, compact=selection.compact)

    def _left(self, client: viser.ClientHandle) -> None:
        self.frames.pop(client.client_id, None)


def frame_class(choice: Choice) -> "type[Frame]":
    """What shows a choice; imported when a page first asks for it, since a robot needs MuJoCo."""
    if isinstance(choice, RoadChoice):
        from app.scenes.road_frame import RoadFrame

        return RoadFrame
    if isinstance(choice, ReplayChoice):
        from app.scenes.replay import ReplayFrame

        return ReplayFrame
    from app.scenes.states import StatesFrame

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
            # viser's script, which colours the page, takes a second to start.
            colour = BACKGROUND["dark" if "darkMode" in request.path else "light"]
            _insert_style(answered, f"html {{ background: {colour} }}")
    return answered


def _insert_style(page: Response, style: str) -> None:
    packed = page.headers.get("Content-Encoding") == "gzip"
    html = gzip.decompress(page.body) if packed else page.body
    html = html.replace(b"<head>", f"<head><style>{style}</style>".encode(), 1)
    page.body = gzip.compress(html, 1) if packed else html
    if "Content-Length" in page.headers:
        del page.headers["Content-Length"]
        page.headers["Content-Length"] = str(len(page.body))


def main() -> None:
    """Serve until SIGTERM."""
    plugins.load()
    links = Links.from_environment()
    served = SceneServer(links)

    def tick() -> None:
        then = time.monotonic()
        while True:
            time.sleep(TICK_S)
            now = time.monotonic()
            served.tick(now - then)
            then = now

    threading.Thread(target=tick, daemon=True).start()
    listen(links.control, served.select, served.clock)


if __name__ == "__main__":
    main()
