"""The studio's door: which pages may connect, which may act, and the path before all addresses."""

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import PlainTextResponse, RedirectResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from starlette.websockets import WebSocketClose

from app.links import Links
from tom.machine.address import refusal

KEY = "Tom-Studio-Key"
"""the header with the key that the browser gave"""
PROTOCOLS = "sec-websocket-protocol"
PREFIX = "tom-studio-key."
"""prefix of the key in the websocket protocols; a key in the address would appear in logs"""
POLICY = "frame-ancestors 'self'; connect-src 'self' data: blob:"
"""only the studio shows its pages; a viewer takes what it shows from nowhere else, whatever its
address says"""


class Guard:
    """ASGI middleware for everything that the studio serves."""

    def __init__(self, app: ASGIApp, links: Links) -> None:
        self._app = app
        self._links = links

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return

        async def sending(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message).append("Content-Security-Policy", POLICY)
            await send(message)

        base, path = self._links.base, scope["path"]
        asked = Headers(scope=scope).get
        if why := refusal(asked, self._links.host, proxied=bool(base)):
            answer = PlainTextResponse(why, status_code=403)
            refused = WebSocketClose(1008, why) if scope["type"] == "websocket" else answer
            await refused(scope, receive, send)
        elif f"{path}/" == base:  # addresses in pages are relative to the slash
            await RedirectResponse(base)(scope, receive, send)
        else:
            if base and path.startswith(base):  # else the proxy has taken it off
                scope = {**scope, "root_path": base.rstrip("/")}
            if scope["type"] == "websocket":
                await self._app(_with_key(scope), receive, send)
            else:
                await self._app(scope, receive, sending)


def _with_key(scope: Scope) -> Scope:
    """The scope of a socket, with the key moved from its protocols to a header."""
    offered = [
        name.strip() for name in ",".join(Headers(scope=scope).getlist(PROTOCOLS)).split(",")
    ]
    keys = [name.removeprefix(PREFIX) for name in offered if name.startswith(PREFIX)]
    others = ", ".join(name for name in offered if not name.startswith(PREFIX))
    replaced = {KEY.lower().encode(), PROTOCOLS.encode()}
    headers = [(name, value) for name, value in scope["headers"] if name not in replaced]
    headers.append((PROTOCOLS.encode(), others.encode("latin-1")))
    headers += [(KEY.lower().encode(), key.encode("latin-1")) for key in keys[:1]]
    return {**scope, "headers": headers}
