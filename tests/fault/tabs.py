"""A studio's page without a browser: Streamlit's own messages on its socket."""

from importlib import import_module
from typing import Any, Self

from websockets.sync.client import ClientConnection, connect
from websockets.typing import Origin, Subprotocol

from app.guard import PREFIX
from app.links import Links

BACK = import_module("streamlit.proto.BackMsg_pb2")
FORWARD = import_module("streamlit.proto.ForwardMsg_pb2")


class Tab:
    """One page; `key` is what its browser has kept of the address that was opened."""

    def __init__(self, links: Links, page: str = "", key: str = "") -> None:
        self._page = page
        self._socket = stream(links, f"http://127.0.0.1:{links.port}", key)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close()

    def draw(self, **clicked: str) -> list[Any]:
        """Draw the page after the widgets with these ids, by kind of value, were clicked."""
        message = BACK.BackMsg()
        message.rerun_script.page_name = self._page
        message.rerun_script.context_info.url = f"http://127.0.0.1/{self._page}"
        for kind, name in clicked.items():
            widget = message.rerun_script.widget_states.widgets.add()
            widget.id = name
            setattr(widget, kind, True)
        self._socket.send(message.SerializeToString())
        drawn: list[Any] = []
        while True:
            answer = FORWARD.ForwardMsg()
            answer.ParseFromString(self._socket.recv(60))
            if answer.WhichOneof("type") == "delta":
                drawn.append(answer.delta)
            if answer.WhichOneof("type") == "script_finished":
                return drawn


def stream(links: Links, origin: str | None, key: str = "", host: str = "") -> ClientConnection:
    """Streamlit's socket, opened by a page of `origin` that asks for `host`."""
    offered = ["streamlit", "none", *([PREFIX + key] if key else [])]
    return connect(
        f"ws://{host or '127.0.0.1'}:{links.port}/_stcore/stream",
        origin=None if origin is None else Origin(origin),
        subprotocols=[Subprotocol(name) for name in offered],
        proxy=None,
        max_size=None,
    )


def buttons(drawn: list[Any]) -> dict[str, str]:
    """The ids of a page's buttons by their labels."""
    elements = [delta.new_element for delta in drawn if delta.WhichOneof("type") == "new_element"]
    made = [element.button for element in elements if element.WhichOneof("type") == "button"]
    return {button.label: button.id for button in made}


def folds(drawn: list[Any]) -> dict[str, str]:
    """The ids of a page's folded parts by their labels."""
    blocks = [delta.add_block for delta in drawn if delta.WhichOneof("type") == "add_block"]
    made = [block.expandable for block in blocks if block.WhichOneof("type") == "expandable"]
    return {fold.label: fold.id for fold in made}
