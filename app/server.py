"""Streamlit's process: the pages, and the recordings that the Rerun viewer loads."""

import logging
from pathlib import Path

import streamlit as st
from starlette.requests import Request
from starlette.responses import (
    FileResponse,
    JSONResponse,
    PlainTextResponse,
    RedirectResponse,
    Response,
)
from starlette.routing import Route

from app import shortlinks
from app.links import Links
from app.plot import LIBRARY, LIBRARY_PATH
from app.router import VIEWS
from app.shell import page_routes
from app.theme import streamlit_options
from tom.errors import UserError
from tom.record.reader import RunReader
from tom.record.store import Store

ENTRY = Path(__file__).with_name("main.py")


def routes(links: Links) -> list[Route]:
    """What this server answers beside the pages."""

    def recording(request: Request) -> Response:
        path = recording_path(links.store, request.path_params["run"], request.path_params["name"])
        if path is None:
            return PlainTextResponse("no such recording", status_code=404)
        # The viewer's page comes from another port, so the browser asks for leave to read.
        headers = {"Access-Control-Allow-Origin": viewer_origin(request, links)}
        headers |= {"Vary": "Origin", "Cache-Control": "no-store"}
        return FileResponse(path, media_type="application/octet-stream", headers=headers)

    def health(_: Request) -> Response:
        return JSONResponse({"store": links.store, "status": "ok"})

    def library(_: Request) -> Response:
        return FileResponse(LIBRARY, headers={"Cache-Control": "max-age=31536000, immutable"})

    def short(request: Request) -> Response:
        found = shortlinks.target(links.store, request.path_params["code"])
        if found is None:
            return PlainTextResponse("no such view", status_code=404)
        return RedirectResponse(found, status_code=302)

    return [
        Route("/v/{code}", short),
        Route("/rrd/{run}/{name}", recording),
        Route("/api/health", health),
        Route(LIBRARY_PATH, library),
        *page_routes([view.PATH for view in VIEWS]),
    ]


def recording_path(store: str, run_id: str, name: str) -> Path | None:
    """The file of a run's recording; None for anything that is not one."""
    try:
        files = RunReader(Store(store).resolve(run_id)).rrd_files()
    except UserError:
        return None
    found = next((path for path in files if path.name == name), None)
    return found if found is not None and found.is_file() and not found.is_symlink() else None


def viewer_origin(request: Request, links: Links) -> str:
    """The one origin that may read recordings: the Rerun viewer on the host that was asked."""
    return f"http://{request.url.hostname}:{links.rerun_web_port}"


def options(links: Links) -> dict:
    """Streamlit's settings: local, silent, no telemetry, no file watching."""
    return {
        "server.address": links.host,
        "server.port": links.port,
        "server.headless": True,
        "server.fileWatcherType": "none",
        "server.allowedHosts": links.allowed_hosts,
        "server.showEmailPrompt": False,
        "browser.gatherUsageStats": False,
        "client.toolbarMode": "minimal",
        "client.showErrorDetails": "full",
        "client.showErrorLinks": False,
        **streamlit_options(links.theme),
    }


def main() -> None:
    """Serve until SIGTERM."""
    logging.getLogger("streamlit").setLevel(logging.WARNING)
    links = Links.from_environment()
    st.App(ENTRY.resolve(), routes=routes(links)).run(config=options(links))


if __name__ == "__main__":
    main()
