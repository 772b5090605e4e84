"""Access control for Streamlit's server: which pages may connect, and which may act."""

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import PlainTextResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from starlette.websockets import WebSocketClose

from app.links import Links
from tom.machine.address import framing, refusal

KEY = "Tom-Studio-Key"
"""the header with the key that the browser gave"""
OFFERED = "sec-websocket-protocol"
PREFIX = "tom-studio-key."
"""prefix of the key in the websocket protocols; a key in the address would appear in logs"""


class Guard:
    """ASGI middleware for everything that Streamlit serves."""

    def __init__(self, app: ASGIApp, links: Links) -> None:
        self._app = app
        self._links = links
        self._framing = framing(links.host, links.port)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
        elif why := self._refusal(scope):
            answer = PlainTextResponse(why, status_code=403)
            refused = WebSocketClose(1008, why) if scope["type"] == "websocket" else answer
            await refused(scope, receive, send)
        elif scope["type"] == "websocket":
            await self._app(_with_key(scope), receive, send)
        else:
            await self._app(scope, receive, self._framed(send))

    def _refusal(self, scope: Scope) -> str | None:
        # The Rerun viewer's page comes from another port and may read only recordings.
        reads = scope["type"] == "http" and scope["path"].startswith("/rrd/")
        pages = (self._links.rerun_port,) if reads else ()
        return refusal(Headers(scope=scope).get, self._links.host, self._links.port, pages)

    def _framed(self, send: Send) -> Send:
        async def sending(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message).append("Content-Security-Policy", self._framing)
            await send(message)

        return sending


def _with_key(scope: Scope) -> Scope:
    """The scope of a socket, with the key moved from its protocols to a header."""
    offered = [name.strip() for name in ",".join(Headers(scope=scope).getlist(OFFERED)).split(",")]
    keys = [name.removeprefix(PREFIX) for name in offered if name.startswith(PREFIX)]
    others = ", ".join(name for name in offered if not name.startswith(PREFIX))
    gone = {KEY.lower().encode(), OFFERED.encode()}
    headers = [(name, value) for name, value in scope["headers"] if name not in gone]
    headers.append((OFFERED.encode(), others.encode("latin-1")))
    headers += [(KEY.lower().encode(), key.encode("latin-1")) for key in keys[:1]]
    return {**scope, "headers": headers}
