"""The Rerun web viewer's page, served so that it speaks to this machine only.

The page in Rerun's wheel asks the network for fonts, for the newest release and sends usage
statistics. It is served here without the fonts and with a `fetch` that knows local hosts only.
"""

import re
import threading
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from http.client import HTTPConnection
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.metadata import version
from urllib.parse import unquote

from tom.errors import UserError
from tom.machine.address import allowed, family, names

FONTS = re.compile(rb"<link[^>]*fonts\.(?:googleapis|gstatic)\.com[^>]*>")

LOCAL_ONLY = b"""<script>
  // Neither a version check nor statistics: other hosts are never asked, and never answer.
  const fetchAnywhere = window.fetch.bind(window);
  const local = new Set([location.hostname, "127.0.0.1", "localhost"]);
  window.fetch = (target, options) => {
    const url = new URL(target instanceof Request ? target.url : target, location.href);
    return local.has(url.hostname) ? fetchAnywhere(target, options) : new Promise(() => {});
  };
</script>
"""

LIVE = re.compile(r"/live/([^/]+)\.rrd")

ETAG = f'"rerun-{version("rerun-sdk")}-1"'


@dataclass(frozen=True)
class Asset:
    """One file of the viewer."""

    body: bytes
    headers: dict[str, str]


def local_page(html: bytes) -> bytes:
    """The viewer's page without its requests to the outside."""
    return FONTS.sub(b"", html).replace(b"<head>", b"<head>\n" + LOCAL_ONLY, 1)


class Server(ThreadingHTTPServer):
    """Serves the viewer that listens on `upstream`, host and port, and growing recordings.

    `live` gives the bytes of a run's recording for as long as it grows; UserError where there is
    no such run. Raises OSError when the port is taken.
    """

    daemon_threads = True

    def __init__(
        self,
        host: str,
        port: int,
        upstream: tuple[str, int],
        live: Callable[[str], Iterator[bytes]],
    ) -> None:
        self.upstream = upstream
        self.live = live
        self.assets: dict[str, Asset] = {}
        # A page on another name for this address could otherwise read what is recorded here.
        self.names = names(host)
        self.address_family = family(host)
        super().__init__((host, port), Handler)

    def start(self) -> None:
        """Serve from a thread of its own until `shutdown`."""
        threading.Thread(target=self.serve_forever, name="rerun-page", daemon=True).start()


class Handler(BaseHTTPRequestHandler):
    """Answers one request."""

    server: Server  # pyright: ignore[reportIncompatibleVariableOverride]

    def do_GET(self) -> None:
        path = self.path.partition("?")[0]
        if not allowed(self.headers.get("Host", ""), self.server.names):
            self.send_error(403, "this address is served under its own name only")
        elif run := LIVE.fullmatch(path):
            self._stream(unquote(run[1]))
        elif self.headers.get("If-None-Match") == ETAG:
            self.send_response(304)
            self.end_headers()
        else:
            self._asset(path)

    def _asset(self, path: str) -> None:
        assets = self.server.assets
        try:
            asset = assets.get(path) or assets.setdefault(path, _fetch(self.server.upstream, path))
        except OSError:
            self.send_error(502, "the Rerun hub does not answer")
            return
        self.send_response(200)
        for name, value in asset.headers.items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(asset.body)

    def _stream(self, run_id: str) -> None:
        try:
            parts = self.server.live(run_id)
        except UserError as error:
            self.send_error(404, str(error)[:200])
            return
        self.send_response(200)
        self.send_header("Content-Type", "application/octet-stream")
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        with suppress(ConnectionError):  # the viewer was closed
            for part in parts:
                self.wfile.write(part)
                self.wfile.flush()

    def log_message(self, format: str, *args: object) -> None:
        """Requests are not worth a line each."""


def _fetch(upstream: tuple[str, int], path: str) -> Asset:
    connection = HTTPConnection(*upstream, timeout=30)
    try:
        connection.request("GET", path)
        answer = connection.getresponse()
        body = answer.read()
        kind = answer.getheader("Content-Type") or "application/octet-stream"
        if answer.status != 200:
            raise OSError(f"{path}: {answer.status}")
    finally:
        connection.close()
    if kind.startswith("text/html"):
        body = local_page(body)
    size = str(len(body))
    headers = {"Content-Type": kind, "Content-Length": size, "rerun-final-length": size}
    return Asset(body, headers | {"ETag": ETAG, "Cache-Control": "no-cache"})
