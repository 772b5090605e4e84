"""The server of the Rerun web viewer's page, which connects only to this machine.

The page in Rerun's wheel loads fonts, asks for the newest release and sends usage statistics. Here
it is served without the fonts and with a `fetch` that is restricted to local hosts.
"""

import logging
import re
import select
import socket
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from http import HTTPStatus
from http.client import HTTPConnection
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.metadata import version
from itertools import chain
from urllib.parse import unquote

from tom.errors import UserError
from tom.machine.address import family, framing, refusal

_log = logging.getLogger(__name__)

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

LIVE = re.compile(r"/live(?:/([^/]+))?\.rrd")
FILES = ("/", "/re_viewer.js", "/re_viewer_bg.wasm", "/favicon.ico", "/sw.js")

ETAG = f'"rerun-{version("rerun-sdk")}-1"'


@dataclass(frozen=True)
class Asset:
    """One file of the viewer."""

    body: bytes
    headers: dict[str, str]


def local_page(html: bytes) -> bytes:
    """The viewer's page without requests to other machines."""
    return FONTS.sub(b"", html).replace(b"<head>", b"<head>\n" + LOCAL_ONLY, 1)


class ViewerServer(ThreadingHTTPServer):
    """Serves the viewer's `files` by their paths, and growing recordings.

    `live` yields the bytes of a run's recording as long as it grows, for an empty name those of all
    running trainings; UserError if there is no such run. It yields empty bytes from time to time,
    so that a closed viewer is noticed. The pages on `studio_port` may embed the viewer. Raises
    OSError if the port is taken.
    """

    daemon_threads = True

    def __init__(
        self,
        host: str,
        port: int,
        files: Mapping[str, Asset],
        live: Callable[[str], Iterator[bytes]],
        studio_port: int = 0,
    ) -> None:
        self.files = files
        self.live = live
        self.host = host
        self.framing = framing(host, studio_port)
        self.address_family = family(host)
        super().__init__((host, port), Handler)

    def start(self) -> None:
        """Serve from a new thread until `shutdown`."""
        threading.Thread(target=self.serve_forever, name="rerun-page", daemon=True).start()


class Handler(BaseHTTPRequestHandler):
    """Answers one request."""

    server: ViewerServer  # pyright: ignore[reportIncompatibleVariableOverride]

    def do_GET(self) -> None:
        path = self.path.partition("?")[0]
        if why := refusal(self.headers.get, self.server.host, self.server.server_port):
            self._say(403, why)
        elif run := LIVE.fullmatch(path):
            self._stream(unquote(run[1] or ""))
        elif path not in self.server.files:
            self._say(404, "no such file")
        elif self.headers.get("If-None-Match") == ETAG:
            self.send_response(304)
            self.end_headers()
        else:
            self._file(self.server.files[path])

    def _file(self, file: Asset) -> None:
        self.send_response(200)
        for name, value in file.headers.items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(file.body)

    def _stream(self, run_id: str) -> None:
        try:
            parts = self.server.live(run_id)
            first = next(parts, b"")  # an error comes here, before the response has begun
        except UserError:
            self._say(404, "no such run")
            return
        except Exception as error:
            _log.warning("cannot show %r in Rerun: %s", run_id, error)
            self._say(500, "this run cannot be shown")
            return
        self.send_response(200)
        self.send_header("Content-Type", "application/octet-stream")
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        with suppress(ConnectionError):  # the viewer was closed
            for part in chain([first], parts):
                self.wfile.write(part)
                self.wfile.flush()
                if not part and _gone(self.connection):
                    return

    def end_headers(self) -> None:
        self.send_header("Content-Security-Policy", self.server.framing)
        super().end_headers()

    def _say(self, code: int, words: str) -> None:
        """Answer with our own text, which must not repeat the untrusted request."""
        self.send_response(code)
        self.send_header("Content-Type", "text/plain; charset=utf-8")
        self.send_header("X-Content-Type-Options", "nosniff")
        self.send_header("Content-Length", str(len(words.encode())))
        self.end_headers()
        self.wfile.write(words.encode())

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:
        """Errors of the base class, without its message, which quotes the request."""
        self.close_connection = True
        self._say(code, self.responses[HTTPStatus(code)][0])

    def log_message(self, format: str, *args: object) -> None:
        """Print nothing for a request."""


def assets(upstream: tuple[str, int]) -> dict[str, Asset]:
    """The viewer's files by path, from Rerun's own server on host and port `upstream`.

    Raises OSError if it does not answer or has unknown files.
    """
    return {path: _fetch(upstream, path) for path in FILES}


def _gone(connection: socket.socket) -> bool:
    """Whether the other end has closed the connection."""
    readable, _, _ = select.select([connection], [], [], 0)
    return bool(readable) and not connection.recv(1, socket.MSG_PEEK)


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
