"""The viser server's process: one scene per browser frame, controlled by the pages."""

import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import viser
from websockets.asyncio import server

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
from tom import plugins
from tom.errors import UserError

if TYPE_CHECKING:
    from app.scenes.frame import Frame

TICK_S, REST_S = 1 / 30, 0.5
"""seconds between two looks at the time, with a frame and without one"""


class SceneServer:
    """The frames, by the name of the page that embeds them."""

    def __init__(self, links: Links) -> None:
        self.links = links
        self.selections: dict[str, Selection] = {}
        self.carried_out: dict[str, int] = {}
        """by page, its last request that a frame has carried out"""
        self.frames: dict[int, tuple[str, Frame]] = {}
        with on_socket(links.file("scenes")):
            self.server = viser.ViserServer(verbose=False)
        self.server.scene.set_up_direction("+z")
        self.server.on_client_connect(self._connected)
        self.server.on_client_disconnect(self._disconnected)

    def select(self, page: str, selection: Selection) -> None:
        """Store a page's selection and show it in its frames."""
        before, self.selections[page] = self.selections.get(page), selection
        here = [frame.client for name, frame in list(self.frames.values()) if name == page]
        if here and before != selection:
            self._show(page, here)

    def clock(self, page: str) -> Clock | None:
        """The clock of a page's frame; None if nothing plays there."""
        frames = [frame for _, (name, frame) in list(self.frames.items()) if name == page]
        return next((clock for frame in reversed(frames) if (clock := frame.clock())), None)

    def tick(self, seconds: float) -> None:
        """Advance all frames by `seconds`."""
        for _, frame in list(self.frames.values()):
            frame.tick(seconds)

    def _connected(self, client: viser.ClientHandle) -> None:
        # viser has no public attribute for a client's request; its path names the page.
        request = self.server._websock_server._live_connections[client.client_id].request
        if request is not None:  # else it has disconnected already
            self._show(request.path.strip("/"), [client])

    def _show(self, page: str, clients: Sequence[viser.ClientHandle]) -> None:
        """Show a page's selection in its frames.

        They carry out its request if none has yet: so a request waits for the page's first frame,
        and a frame that connects again does not repeat it.
        """
        frames = [self._frame_of(client, page) for client in clients]
        selection = self._selection(page)  # it may have changed while they were built
        request = getattr(selection.choice, "request", 0)
        obey, self.carried_out[page] = request > self.carried_out.get(page, 0), request
        for frame in frames:
            if frame is None:
                continue
            try:
                frame.show(selection, obey=obey)
            except UserError as error:  # deleted or damaged meanwhile; the last picture stays
                frame.client.add_notification("Not shown", str(error), auto_close_seconds=8)

    def _selection(self, page: str) -> Selection:
        return self.selections.get(page, Selection(RoadChoice(), self.links.theme or "light"))

    def _frame_of(self, client: viser.ClientHandle, page: str) -> "Frame | None":
        """A client's frame for what its page shows; None if its tab was closed while it was built
        (see `_disconnected`)."""
        number, selection = client.client_id, self._selection(page)
        current = self.frames.get(number)
        if current is not None and type(current[1]) is frame_class(selection.choice):
            return current[1]
        if current is not None:
            current[1].close()
        frame = frame_class(selection.choice)(client, selection.mode)
        self.frames[number] = page, frame
        if number in self.server.get_clients():
            return self._frame_of(client, page)  # the page may show another kind by now
        self.frames.pop(number, None)
        return None

    def _disconnected(self, client: viser.ClientHandle) -> None:
        self.frames.pop(client.client_id, None)


KINDS = {RoadChoice: "road.RoadFrame", ReplayChoice: "replay.ReplayFrame",
         StatesChoice: "states.StatesFrame"}  # fmt: skip


def frame_class(choice: Choice) -> "type[Frame]":
    """What shows a choice; imported when a page first asks for it, since a robot needs MuJoCo."""
    module, _, name = KINDS[type(choice)].partition(".")
    return getattr(import_module(f"app.scenes.{module}"), name)


@contextmanager
def on_socket(path: Path) -> Iterator[None]:
    """Websocket servers started inside the block listen on a socket that only this user can open.

    viser listens on a port, where it answers every page in a browser, and has no option for this.
    """
    serve = server.serve

    def serve_there(handler: Any, _host: str, _port: int, **options: Any) -> server.serve:
        return serve(handler, unix=True, path=str(path), **options)

    path.unlink(missing_ok=True)  # left by a killed server
    server.serve = serve_there  # pyright: ignore[reportAttributeAccessIssue]
    try:
        yield
    finally:
        server.serve = serve


def main() -> None:
    """Serve until SIGTERM."""
    plugins.load()
    links = Links.from_environment()
    scene_server = SceneServer(links)

    def tick() -> None:
        then = time.monotonic()
        while True:
            time.sleep(TICK_S if scene_server.frames else REST_S)
            now = time.monotonic()
            scene_server.tick(now - then)
            then = now

    threading.Thread(target=tick, daemon=True).start()
    listen(str(links.file("control")), scene_server.select, scene_server.clock)


if __name__ == "__main__":
    main()
