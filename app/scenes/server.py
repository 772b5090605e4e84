"""The viser server's process: one scene per browser frame, controlled by the pages."""

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import viser
from websockets.asyncio import server

from app.links import Links
from app.scenes.control import Choice, Clock, ReplayChoice, RoadChoice, Selection, listen
from tom import plugins
from tom.errors import UserError

if TYPE_CHECKING:
    from app.scenes.frame import Frame

TICK_S = 1 / 30


class SceneServer:
    """The frames, by the name of the page that embeds them."""

    def __init__(self, links: Links) -> None:
        self.links = links
        self.chosen: dict[str, Selection] = {}
        self.heard: dict[str, int] = {}
        """by page, its last request that a frame has carried out"""
        self.frames: dict[int, tuple[str, Frame]] = {}
        with on_socket(links.scenes):
            self.server = viser.ViserServer(verbose=False)
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
        # viser has no public attribute for a client's request; its path names the page.
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
def on_socket(path: str) -> Iterator[None]:
    """Websocket servers started inside the block listen on a socket that only this user can open.

    viser listens on a port, where it answers every page in a browser, and has no option for this.
    """
    serve = server.serve

    def serve_there(handler: Any, _host: str, _port: int, **options: Any) -> server.serve:
        return serve(handler, unix=True, path=path, **options)

    Path(path).unlink(missing_ok=True)  # left by a killed server
    server.serve = serve_there  # pyright: ignore[reportAttributeAccessIssue]
    try:
        yield
    finally:
        server.serve = serve


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
