"""The page server: Streamlit, everything else that pages ask for, and the 3D server beside it."""

import logging
import sys
import time
from pathlib import Path
from threading import Thread
from urllib.parse import parse_qsl, urlencode

import streamlit as st
from starlette.concurrency import run_in_threadpool
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import (
    FileResponse,
    HTMLResponse,
    JSONResponse,
    PlainTextResponse,
    RedirectResponse,
    Response,
)
from starlette.routing import BaseRoute, Route
from streamlit import config, file_util

from app import text
from app.data import cache, readers, studies
from app.guard import Guard
from app.links import Links
from app.parts import shortlinks
from app.parts.plot import LIBRARY, LIBRARY_PATH
from app.router import FIRST, VIEWS, views
from app.servers import viewers
from app.theme import streamlit_options
from tom import plugins
from tom.machine import processes

CACHE_FOREVER = "max-age=31536000, immutable"
"""how long a browser keeps what never changes at its address"""
FIRST_S = 10.0
"""how long the imports of other pages wait for the first drawing"""
RESTART_S = 3.0
"""from the end of a 3D server to the next"""
LARGEST_FIGURE = 20_000_000
"""bytes of a figure that a page sends to have it drawn for a paper"""
FORWARDED = {
    "/live": ("/", {}),
    "/answer": ("/", {}),
    "/compare": ("/curves", {}),
    "/weights": ("/attention", {}),
    "/regions": ("/attention", {}),
    "/probe": ("/attention", {"part": "Every learner on one buffer"}),
    "/road": ("/attention", {"task": "road-and-rocks"}),
    "/cinema": ("/replays", {"part": "Film"}),
    "/studies": ("/findings", {}),
}
"""pages of older studios, by their address: today's address and its choices"""
RENAMED = {
    ("/compare", "env"): "task",
    ("/compare", "text"): "find",
    ("/compare", "show"): "part",
    ("/compare", "metric"): "panel",
    ("/probe", "at"): "step",
}
"""choices of older pages that have another name today"""

ENTRY = Path(__file__).with_name("main.py")
# Streamlit's own page first looks for its server below the opened address
# (`/compare/_stcore/health`), which gives errors in the console. And it makes an entry of the
# browser's history when the server changes the address.
_HEAD = """<head>
    <script>
      {
        const root = new URL(".", location.href).href;
        window.__streamlit = { BACKEND_BASE_URL: root, MAIN_PAGE_BASE_URL: root };
        // The key stands behind the # of the address that the terminal printed. It is kept where
        // this port's pages alone read it: a browser gives a cookie to every port of a host. Behind
        // a proxy, several studios may have one port.
        const kept = `tom-studio-key${new URL(root).pathname}`;
        const given = /^#key=([\\w-]+)$/.exec(location.hash);
        if (given) {
          localStorage.setItem(kept, given[1]);
          history.replaceState(null, "", location.pathname + location.search);
        }
        const key = localStorage.getItem(kept);
        // Streamlit keeps a theme for every address; the studio has one for all pages.
        const theme = localStorage.getItem("tom-studio-theme");
        if (theme) {
          localStorage.setItem(`stActiveTheme-${location.pathname}-v2`, JSON.stringify(theme));
        }
        window.WebSocket = class extends window.WebSocket {
          constructor(address, offered) {
            super(address, key ? [...offered, `tom-studio-key.${key}`] : offered);
          }
        };
        // One entry of the history for each act of the visitor: where the page corrects its
        // address by itself, Back would lead to what it corrects again.
        const push = history.pushState.bind(history);
        let acted = false;
        for (const act of ["pointerdown", "keydown"]) {
          addEventListener(act, () => { acted = true; }, { capture: true });
        }
        history.pushState = (...entry) => {
          if (acted) push(...entry);
          else history.replaceState(...entry);
          acted = false;
        };
      }
    </script>"""


def routes(links: Links) -> list[BaseRoute]:
    """The routes of this server besides the pages."""

    def report(request: Request) -> Response:
        path = studies.report(request.path_params["study"], *studies.folders(links.store))
        if path is None:
            return PlainTextResponse("no such report", status_code=404)
        # A report contains its figures and style; it needs no scripts or external resources.
        allowed = "sandbox; default-src 'none'; img-src data:; style-src 'unsafe-inline'"
        return FileResponse(path, headers={"Content-Security-Policy": allowed})

    def array(request: Request) -> Response:
        content = cache.published_array(request.path_params["name"])
        if content is None:
            return PlainTextResponse("no such array", status_code=404)
        headers = {"Cache-Control": f"private, {CACHE_FOREVER}", **viewers.UNCOMPRESSED}
        return Response(content, media_type="application/octet-stream", headers=headers)

    async def figure(request: Request) -> Response:
        from app.figures import paper  # here: it imports matplotlib

        kind, width = (request.query_params.get(name, "") for name in ("kind", "width"))
        try:
            if int(request.headers.get("content-length", LARGEST_FIGURE + 1)) > LARGEST_FIGURE:
                raise ValueError("the figure is too large")
            content = await request.json()
            file = await run_in_threadpool(paper.paper_figure, content, width, kind)
        except Exception as error:  # whatever the drawing of something raises that is no figure
            return PlainTextResponse(f"this figure cannot be drawn: {error!r}", status_code=400)
        return Response(file, media_type=paper.KINDS[kind])

    def short(request: Request) -> Response:
        code = request.path_params["code"]
        target = shortlinks.target(links.store, code)
        if target is None:
            return PlainTextResponse(shortlinks.NOWHERE.format(code[:40]), status_code=404)
        return RedirectResponse(f"..{target}", status_code=302)

    def forward(request: Request) -> Response:
        page = request.url.path.rpartition("/")[2]
        return RedirectResponse(f".{forwarded(f'/{page}', request.url.query)}")

    health = {"store": links.store, "status": "ok", "launch": links.launch}
    kept = {"Cache-Control": CACHE_FOREVER, **viewers.UNCOMPRESSED}
    shell, fresh = html(), {"Cache-Control": "no-cache"}
    return [
        Route("/v/{code}", short),
        *[Route(path, forward) for path in FORWARDED],
        Route(f"/{text.GLOSSARY_PATH}", lambda _: HTMLResponse(text.glossary())),
        Route("/reports/{study}", report),
        Route("/api/health", lambda _: JSONResponse(health)),
        Route(f"/{LIBRARY_PATH}", lambda _: FileResponse(LIBRARY, headers=kept)),
        Route(f"/{cache.ARRAYS}/{{name}}", array),
        Route("/api/figure", figure, methods=["POST"]),
        *viewers.routes(links),
        *[Route(f"/{v.PATH}", lambda _: HTMLResponse(shell, headers=fresh)) for v in views()],
    ]


def html() -> str:
    """Streamlit's page with the studio's script in its head."""
    return Path(file_util.get_static_dir(), "index.html").read_text().replace("<head>", _HEAD, 1)


def forwarded(path: str, query: str) -> str:
    """The address of today's page for one of an older studio."""
    page, more = FORWARDED[path]
    given = parse_qsl(query)
    if path == "/compare" and ("show", "Side by side") in given:
        page = "/replays"
    given = [(RENAMED.get((path, name), name), value) for name, value in given]
    words = urlencode([*more.items(), *given])
    return f"{page}?{words}".removesuffix("?")


def options(links: Links) -> dict:
    """Streamlit's settings: local, silent, no telemetry, no file watching.

    Without its collection of all garbage after every drawing of a page or a part of it: Python's
    own keeps the memory as it is, and a page at rest costs half as much.
    """
    return {
        "server.address": links.host,
        "server.port": links.port,
        "server.headless": True,
        "server.fileWatcherType": "none",
        "server.showEmailPrompt": False,
        "runner.postScriptGC": False,
        "browser.gatherUsageStats": False,
        # Otherwise Streamlit's cloud may send messages to a page that it has opened.
        "client.allowedOrigins": [],
        "client.toolbarMode": "minimal",
        "client.showErrorDetails": "full",
        "client.showErrorLinks": False,
        **streamlit_options(links.theme),
    }


def warm_up(links: Links) -> None:
    """Make ready what a visitor would wait for: the first page and all metrics before its drawing,
    which gets the whole processor; then the other pages, which import torch."""
    VIEWS[0].load()
    for run in readers.listing(links.store).runs:
        readers.metrics(run)
    Thread(target=keep_scenes, args=(links,), daemon=True).start()
    FIRST.wait(FIRST_S)
    for view in VIEWS:
        view.load()


def keep_scenes(links: Links) -> None:
    """Run the 3D server, and again where it ended; the pages go on without it."""
    while True:
        with links.file("scenes.log").open("ab") as log:
            processes.start([sys.executable, "-m", "app.scenes.server"], log, session=False).wait()
        time.sleep(RESTART_S)


def main() -> None:
    """Serve until SIGTERM."""
    logging.getLogger("streamlit").setLevel(logging.WARNING)
    # The settings of a user's own Streamlit applications, which lie in ~/.streamlit or the current
    # folder, are not meant for the studio.
    config.get_config_files = lambda _name: []
    plugins.load()
    links = Links.from_environment()
    Thread(target=warm_up, args=(links,), daemon=True).start()
    guard = Middleware(Guard, links=links)
    app = st.App(ENTRY.resolve(), routes=routes(links), middleware=[guard])
    app.run(config=options(links))


if __name__ == "__main__":
    main()
