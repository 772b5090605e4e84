"""The Rerun hub of a studio: one process that a launcher starts, watches and ends.

`python -m tom.record.rerun.hub` serves Rerun's web viewer and growing recordings: of all running
trainings in the store, and of any single run. Everything goes over one port, which checks each
request. It listens on 127.0.0.1 unless told otherwise, and ends with its parent.

Rerun's own server answers every page and program that reaches its ports, and has no option against
this. So it runs only until the viewer's files have been copied from it. The page in Rerun's wheel
loads fonts, asks for the newest release and sends usage statistics. Here it is served without the
fonts and with a `fetch` that is restricted to local hosts.
"""

import argparse
import logging
import os
import re
import select
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from http import HTTPStatus
from http.client import HTTPConnection
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.metadata import version
from itertools import chain
from pathlib import Path
from urllib.parse import quote, unquote

import rerun_cli

from tom import plugins
from tom.errors import UserError
from tom.machine import processes
from tom.machine.address import family, framing, free_port, refusal

START_S = 30.0
STOP_S = 3.0

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

_log = logging.getLogger(__name__)


def command(host: str, port: int, store: Path | str, studio_port: int = 0) -> list[str]:
    """The command that runs the hub of `store`; it is ready when GET / on `port` returns 200.

    The pages on `studio_port` may embed the viewer.
    """
    options = {"--host": host, "--port": port, "--store": store, "--studio-port": studio_port}
    given = [str(part) for option in options.items() for part in option]
    return [sys.executable, "-m", "tom.record.rerun.hub", *given]


def viewer_url(host: str, port: int, source: str, theme: str = "dark") -> str:
    """The web viewer's address showing `source`: a `live_url` or a file's URL."""
    query = f"url={quote(source, safe='')}&hide_welcome_screen&persist=false&notebook=false"
    return f"http://{host}:{port}/?{query}&theme={theme}"


def live_url(host: str, port: int, run_id: str = "") -> str:
    """The URL of a growing recording of one run of the store, or of all running ones."""
    return f"http://{host}:{port}/live{f'/{quote(run_id)}' if run_id else ''}.rrd"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the hub until SIGTERM or SIGINT; returns 0, or 1 if Rerun does not start."""
    parser = argparse.ArgumentParser(prog="tom.record.rerun.hub", description=__doc__)
    parser.add_argument("--host", default="127.0.0.1")
    parser.add_argument("--port", type=int, required=True)
    parser.add_argument("--store", type=Path, default=Path("runs"))
    parser.add_argument("--studio-port", type=int, default=0)
    args = parser.parse_args(arguments)
    plugins.load()
    stopping = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stopping.set())
    live = partial(_live, args.store, stopping)
    try:
        server = ViewerServer(args.host, args.port, viewer_files(), live, args.studio_port)
    except TimeoutError as error:
        print(f"the Rerun viewer is not there: {error}", file=sys.stderr)
        return 1
    server.start()
    stopping.wait()
    server.shutdown()
    return 0


def _live(store: Path, stopping: threading.Event, run_id: str) -> Iterator[bytes]:
    # Imported here because the viewer's page does not need it.
    from tom.record.rerun.feed import stream, stream_all
    from tom.record.store import Store

    if run_id:
        return stream(Store(store).run(run_id), stopping)
    return stream_all(Store(store), stopping)


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
        files: Mapping[str, "Asset"],
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
            self._answer(403, why)
        elif run := LIVE.fullmatch(path):
            self._stream(unquote(run[1] or ""))
        elif path not in self.server.files:
            self._answer(404, "no such file")
        elif self.headers.get("If-None-Match") == ETAG:
            self.send_response(304)
            self.end_headers()
        else:
            file = self.server.files[path]
            self._send(200, file.headers, file.body)

    def _stream(self, run_id: str) -> None:
        try:
            parts = self.server.live(run_id)
            first = next(parts, b"")  # an error comes here, before the response has begun
        except UserError:
            self._answer(404, "no such run")
            return
        except Exception as error:
            _log.warning("cannot show %r in Rerun: %s", run_id, error)
            self._answer(500, "this run cannot be shown")
            return
        headers = {"Content-Type": "application/octet-stream", "Cache-Control": "no-store"}
        with suppress(ConnectionError):  # the viewer was closed
            self._send(200, headers)
            for part in chain([first], parts):
                self.wfile.write(part)
                self.wfile.flush()
                if not part and self._closed():
                    return

    def _closed(self) -> bool:
        """Whether the other end has closed the connection."""
        readable, _, _ = select.select([self.connection], [], [], 0)
        return bool(readable) and not self.connection.recv(1, socket.MSG_PEEK)

    def _answer(self, code: int, text: str) -> None:
        """Answer with our own text, which must not repeat the untrusted request."""
        headers = {"Content-Type": "text/plain; charset=utf-8", "X-Content-Type-Options": "nosniff"}
        self._send(code, headers | {"Content-Length": str(len(text.encode()))}, text.encode())

    def _send(self, code: int, headers: Mapping[str, str], body: bytes = b"") -> None:
        self.send_response(code)
        for name, value in headers.items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(body)

    def end_headers(self) -> None:
        self.send_header("Content-Security-Policy", self.server.framing)
        super().end_headers()

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:
        """Errors of the base class, without its message, which quotes the request."""
        self.close_connection = True
        self._answer(code, self.responses[HTTPStatus(code)][0])

    def log_message(self, format: str, *args: object) -> None:
        """Print nothing for a request."""


@dataclass(frozen=True)
class Asset:
    """One file of the viewer."""

    body: bytes
    headers: dict[str, str]


def binary() -> Path:
    """The path of Rerun's program, because killing the wheel's Python wrapper would orphan it."""
    return Path(rerun_cli.__file__).with_name("rerun")


def viewer_files() -> dict[str, Asset]:
    """The web viewer's files by path, from Rerun's own server.

    Raises TimeoutError if that does not answer.
    """
    host, deadline = "127.0.0.1", time.monotonic() + START_S
    port = free_port(host)
    options = ["--serve-web", "--bind", host, "--port", str(free_port(host))]
    command = [str(binary()), *options, "--web-viewer-port", str(port)]
    with tempfile.TemporaryDirectory(prefix="tom-hub-") as folder:
        # In the hub's process group, which the studio ends as a whole, and with the hub's log,
        # which then says why Rerun does not start.
        rerun = processes.start(command, None, without_analytics(Path(folder)), session=False)
        try:
            while True:
                try:
                    return {path: _fetch(host, port, path) for path in FILES}
                except OSError as error:
                    if rerun.poll() is not None or time.monotonic() > deadline:
                        raise TimeoutError(error) from error
                    time.sleep(0.05)
        finally:
            processes.stop([rerun], STOP_S)


def local_page(html: bytes) -> bytes:
    """The viewer's page without requests to other machines."""
    return FONTS.sub(b"", html).replace(b"<head>", b"<head>\n" + LOCAL_ONLY, 1)


def without_analytics(folder: Path) -> dict[str, str]:
    """Environment variables that turn off Rerun's usage statistics; user settings stay."""
    settings = {"XDG_CONFIG_HOME": str(folder), "XDG_DATA_HOME": str(folder)}
    environment = {**os.environ, **settings}
    command = [str(binary()), "analytics", "disable"]
    subprocess.run(command, env=environment, check=True, capture_output=True)
    return environment


def _fetch(host: str, port: int, path: str) -> Asset:
    """A file of Rerun's own server. Raises OSError if it does not answer or has no such file."""
    connection = HTTPConnection(host, port, timeout=30)
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


if __name__ == "__main__":
    # Open streams and torch would delay the exit by seconds.
    code = main()
    sys.stdout.flush()
    os._exit(code)
