"""The viser server's process: one scene a browser frame, told what to show by the pages."""

import threading
import time
from collections.abc import Mapping, Sequence
from urllib.parse import urlsplit

import viser
from websockets.http11 import Request

from app.links import Links
from app.scenes.control import Choice, ReplayChoice, RoadChoice, Selection, StatesChoice, listen
from app.scenes.frame import Frame
from app.scenes.replay_frame import ReplayFrame
from app.scenes.road_frame import RoadFrame
from app.scenes.states_frame import StatesFrame
from tom.errors import UserError

TICK_S = 1 / 30
FRAMES: dict[type[Choice], type[Frame]] = {
    RoadChoice: RoadFrame,
    ReplayChoice: ReplayFrame,
    StatesChoice: StatesFrame,
}
"""which frame shows what a page can choose"""


class SceneServer:
    """Frames by the name of the page that embeds them."""

    def __init__(self, links: Links) -> None:
        self.links = links
        self.chosen: dict[str, Selection] = {}
        self.begun: dict[str, int] = {}
        """how often what a page shows was played from its beginning"""
        self.frames: dict[int, tuple[str, Frame]] = {}
        self.server = viser.ViserServer(links.host, links.viser_port, verbose=False)
        if self.server.get_port() != links.viser_port:  # viser takes the next one in silence
            raise SystemExit(f"port {links.viser_port} is taken")
        self.server.scene.set_up_direction("+z")
        self.server.on_client_connect(self._connected)
        self.server.on_client_disconnect(self._left)

    def select(self, client: str, selection: Selection) -> None:
        """Remember a page's selection and show it in its frames."""
        before = self.chosen.get(client)
        self.chosen[client] = selection
        if before == selection:
            return
        frames = list(self.frames.items())
        here = [(number, frame) for number, (name, frame) in frames if name == client]
        play = bool(here) and self._asked_to_play(client, selection.choice)
        for number, frame in here:
            self._show(number, client, frame, selection, play=play)

    def tick(self, seconds: float) -> None:
        """So much time has passed in every frame."""
        for _, frame in list(self.frames.values()):
            frame.tick(seconds)

    def _asked_to_play(self, name: str, choice: Choice) -> bool:
        """Since a frame of the page last began, the page has asked for it; it counts as begun now.

        So a page's wish waits for its first frame, and a frame that comes back does not begin anew.
        """
        asked = choice.played if isinstance(choice, ReplayChoice) else 0
        begun, self.begun[name] = self.begun.get(name, 0), asked
        return asked > begun

    def _show(
        self, number: int, name: str, frame: Frame, selection: Selection, *, play: bool
    ) -> None:
        if type(frame) is not FRAMES[type(selection.choice)]:
            frame.close()
            frame = self._frame(frame.client, selection)
            if not self._insert(number, name, frame):
                return
        try:
            frame.show(selection, play=play)
        except UserError as error:  # deleted or damaged meanwhile: the last picture stays
            frame.client.add_notification("Not shown", str(error), auto_close_seconds=8)

    def _connected(self, client: viser.ClientHandle) -> None:
        request = self._request(client)
        if request is None or not trusted(request.headers, self.links.allowed_hosts):
            return  # an empty scene: nothing of the store goes to a foreign page
        name = request.path.strip("/")
        selection = self.chosen.get(name, Selection(RoadChoice(), self.links.theme or "light"))
        frame = self._frame(client, selection)
        if not self._insert(client.client_id, name, frame):
            return
        selection = self.chosen.get(name, selection)  # it may have changed while this was built
        play = self._asked_to_play(name, selection.choice)
        self._show(client.client_id, name, frame, selection, play=play)

    def _insert(self, number: int, name: str, frame: Frame) -> bool:
        """Keep a frame, unless its tab was left while it was built: then `_left` has come."""
        self.frames[number] = (name, frame)
        if number in self.server.get_clients():
            return True
        self.frames.pop(number, None)
        return False

    def _frame(self, client: viser.ClientHandle, selection: Selection) -> Frame:
        kind = FRAMES[type(selection.choice)]
        return kind(client, self.links.store, selection.mode, compact=selection.compact)

    def _left(self, client: viser.ClientHandle) -> None:
        self.frames.pop(client.client_id, None)

    def _request(self, client: viser.ClientHandle) -> Request | None:
        # viser hands a client's request on to no public attribute; its path is the one thing
        # that a page can set (`?websocket=` in Links.viser).
        return self.server._websock_server._live_connections[client.client_id].request


def trusted(headers: Mapping[str, str], allowed: Sequence[str]) -> bool:
    """The page that connects was served by this host, under a name that this host goes by.

    viser itself takes connections from every page that a browser shows. No allowed names: any.
    """
    host = urlsplit(f"//{headers.get('Host', '')}").hostname
    origin = urlsplit(headers.get("Origin", "")).hostname
    return host == origin and (not allowed or host in allowed)


def main() -> None:
    """Serve until SIGTERM."""
    links = Links.from_environment()
    served = SceneServer(links)
    threading.Thread(target=listen, args=(links.control, served.select), daemon=True).start()
    then = time.monotonic()
    while True:
        time.sleep(TICK_S)
        now = time.monotonic()
        served.tick(now - then)
        then = now


if __name__ == "__main__":
    main()
