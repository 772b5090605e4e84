"""A small reverse proxy of this machine, as JupyterHub and Open OnDemand have one."""

import asyncio
from collections.abc import Iterator
from contextlib import contextmanager
from http.client import HTTPConnection
from threading import Thread

import uvicorn
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import Response, StreamingResponse
from starlette.routing import Route, WebSocketRoute
from starlette.websockets import WebSocket
from websockets.asyncio.client import connect
from websockets.typing import Origin, Subprotocol

from tom.machine.address import free_port

HOST = "127.0.0.1"
OF_THE_CONNECTION = {"connection", "transfer-encoding", "keep-alive"}


@contextmanager
def reverse_proxy(prefix: str, port: int) -> Iterator[str]:
    """The address of a proxy that forwards what is below `prefix` to `port`, and nothing else."""

    async def forward(request: Request) -> Response:
        connection = HTTPConnection(HOST, port, timeout=60)
        body = await request.body()
        where = f"{request.url.path}?{request.url.query}"

        def ask():
            connection.request(request.method, where, body or None, dict(request.headers))
            return connection.getresponse()

        answer = await run_in_threadpool(ask)
        pieces = iter(lambda: answer.read1(1 << 16), b"")
        response = StreamingResponse(pieces, answer.status)
        response.raw_headers = [
            (name.lower().encode(), value.encode())
            for name, value in answer.getheaders()
            if name.lower() not in OF_THE_CONNECTION
        ]
        return response

    async def carry(browser: WebSocket) -> None:
        async with connect(
            f"ws://{browser.headers['host']}{browser.url.path}?{browser.url.query}",
            host=HOST,
            port=port,
            origin=Origin(browser.headers["origin"]),
            subprotocols=[Subprotocol(name) for name in browser.scope["subprotocols"]] or None,
            max_size=None,
            proxy=None,
        ) as server:
            await browser.accept(server.subprotocol)

            async def down() -> None:
                async for message in server:
                    await (browser.send_text if isinstance(message, str) else browser.send_bytes)(
                        message  # pyright: ignore[reportArgumentType]
                    )

            async def up() -> None:
                while (got := await browser.receive())["type"] == "websocket.receive":
                    await server.send(got.get("bytes") or got.get("text") or "")

            both = [asyncio.ensure_future(way()) for way in (down, up)]
            await asyncio.wait(both, return_when=asyncio.FIRST_COMPLETED)
            for way in both:
                way.cancel()
            await asyncio.gather(*both, return_exceptions=True)

    below = f"{prefix}/{{path:path}}"
    routes = [
        Route(prefix, forward),
        Route(below, forward, methods=["GET", "POST", "HEAD"]),
        WebSocketRoute(below, carry),
    ]
    own = free_port(HOST)
    settings = uvicorn.Config(Starlette(routes=routes), HOST, own, log_level="warning")
    server = uvicorn.Server(settings)
    thread = Thread(target=server.run, daemon=True)
    thread.start()
    try:
        yield f"http://{HOST}:{own}{prefix}"
    finally:
        server.should_exit = server.force_exit = True
        thread.join(10)
