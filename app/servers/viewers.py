"""Routes of the page server for what runs in frames of the pages: viser's scenes, Rerun's viewer.

The frames come from the same address as the pages, so one port and one check serve them all.
"""

import asyncio
import re
import sys
import time
from asyncio.subprocess import PIPE
from collections.abc import AsyncIterator
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from threading import Lock

from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import (
    FileResponse,
    HTMLResponse,
    PlainTextResponse,
    Response,
    StreamingResponse,
)
from starlette.routing import BaseRoute, Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.types import Scope
from starlette.websockets import WebSocket
from websockets.asyncio.client import ClientConnection, unix_connect

from app.links import LIVE, Links
from app.scenes.control import START_S
from app.theme import BACKGROUND
from tom.errors import UserError
from tom.machine.processes import end_with_parent
from tom.record.reader import RunReader
from tom.record.rerun import viewer
from tom.record.store import Store

RECORDING = "application/octet-stream"
EPISODE = re.compile(r"episode-(\d{1,12})-(\d{1,4})-([1-9]\d{0,3})\.rrd")
"""a single evaluation episode: step, number from 0, steps after which the ghost restarts"""
UNCOMPRESSED = {"Content-Encoding": "identity"}
"""not to be compressed: that takes seconds for a viewer, and would hold a stream back"""
NO_STORE = {"Cache-Control": "no-store"}
PIECE_BYTES = 1 << 16
TRY_AGAIN = 1013
"""the code with which a socket is closed while there is no 3D server; viser's page comes back"""


def routes(links: Links) -> list[BaseRoute]:
    """The routes of the 3D scenes, of Rerun's viewer and of the recordings that it shows."""

    async def recording(request: Request) -> Response:
        run_id, name = request.path_params["run"], request.path_params["name"]
        if wanted := EPISODE.fullmatch(name):
            parts = map(int, wanted.groups())
            content = await run_in_threadpool(episode, links.store, run_id, *parts)
            if content is not None:
                return Response(content, media_type=RECORDING, headers=NO_STORE)
        elif name == LIVE and find_run(links.store, run_id):
            pieces = live_recording(links.store, run_id)
            return StreamingResponse(pieces, media_type=RECORDING, headers=NO_STORE | UNCOMPRESSED)
        elif path := recording_path(links.store, run_id, name):
            return FileResponse(path, media_type=RECORDING, headers=NO_STORE)
        return PlainTextResponse("no such recording", status_code=404)

    async def scene(frame: WebSocket) -> None:
        address = f"ws://scenes/{frame.path_params['client']}"
        offered = frame.scope["subprotocols"] or None
        until = time.monotonic() + START_S
        while not links.file("scenes").exists() and time.monotonic() < until:
            await asyncio.sleep(0.05)
        try:
            async with unix_connect(
                str(links.file("scenes")),
                address,
                subprotocols=offered,
                compression=None,
                max_size=None,
                ping_interval=None,
            ) as server:
                await frame.accept(server.subprotocol)
                await _relay(frame, server)
        except OSError:
            await frame.close(TRY_AGAIN)

    return [
        Route("/rrd/{run}/{name}", recording),
        Mount("/rerun", Viewer(links.file("rerun"))),
        Route("/viser/{client}/", scene_page),
        WebSocketRoute("/viser/{client}", scene),
    ]


class Viewer(StaticFiles):
    """The files of Rerun's web viewer, which are unpacked into `folder` when it is first opened."""

    def __init__(self, folder: Path) -> None:
        super().__init__(directory=folder, html=True, check_dir=False)
        self._folder = folder
        self._unpacking = Lock()

    async def check_config(self) -> None:
        """Called before the first file is given out."""
        await run_in_threadpool(self._unpack)

    async def get_response(self, path: str, scope: Scope) -> Response:
        response = await super().get_response(path, scope)
        response.headers.update({**UNCOMPRESSED, "Cache-Control": "no-cache"})
        return response

    def _unpack(self) -> None:
        with self._unpacking:
            if not self._folder.exists():
                viewer.unpack(self._folder)


def scene_page(request: Request) -> Response:
    """viser's page, in its background from the first moment: its script takes a second to start."""
    package = find_spec("viser")
    assert package is not None
    assert package.origin is not None
    html = Path(package.origin).with_name("client").joinpath("build", "index.html").read_text()
    colour = BACKGROUND["dark" if "darkMode" in request.query_params else "light"]
    style = f"<head><style>html {{ background: {colour} }}</style>"
    return HTMLResponse(html.replace("<head>", style, 1), headers=UNCOMPRESSED)


async def _relay(frame: WebSocket, server: ClientConnection) -> None:
    """Carry messages between a frame and the 3D server until one of them hangs up."""

    async def to_frame() -> None:
        while True:
            await frame.send_bytes(await server.recv(decode=False))

    async def to_server() -> None:
        async for message in frame.iter_bytes():
            await server.send(message)

    both = [asyncio.ensure_future(way()) for way in (to_frame, to_server)]
    try:
        await asyncio.wait(both, return_when=asyncio.FIRST_COMPLETED)
    finally:
        for way in both:
            way.cancel()
        await asyncio.gather(*both, return_exceptions=True)  # a message to who has hung up


async def live_recording(store: str, run_id: str) -> AsyncIterator[bytes]:
    """A recording that grows with its run, from a process that ends with its reader."""
    command = [sys.executable, "-m", "tom.record.rerun.feed", store, run_id]
    feed = await asyncio.create_subprocess_exec(*command, stdout=PIPE, preexec_fn=end_with_parent)
    assert feed.stdout is not None
    try:
        while piece := await feed.stdout.read(PIECE_BYTES):
            yield piece
    finally:
        with suppress(ProcessLookupError):  # it has ended
            feed.kill()


def find_run(store: str, run_id: str) -> RunReader | None:
    """The run of that id; None if there is none."""
    with suppress(UserError):
        return Store(store).run(run_id)
    return None


def episode(store: str, run_id: str, step: int, index: int, horizon: int) -> bytes | None:
    """A recording of one evaluation episode and its ghost; None if there is no such episode."""
    from app.data import replays  # here: torch, the simulator and Rerun take seconds to import
    from tom.record.rerun.view import episode_recording

    with suppress(UserError):
        run = Store(store).run(run_id)
        if replay := replays.load(run, step, index, horizon):
            return episode_recording(run, step, replay.episode, replay.dt, replay.ghost)
    return None


def recording_path(store: str, run_id: str, name: str) -> Path | None:
    """The file of a run's recording; None if there is no such recording."""
    run = find_run(store, run_id)
    files = [path for path in (run.rrd_files() if run else ()) if path.name == name]
    return next((path for path in files if path.is_file() and not path.is_symlink()), None)
