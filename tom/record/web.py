"""The Rerun web viewer's page, served so that it speaks to this machine only.

The page in Rerun's wheel asks the network for fonts, for the newest release and sends usage
statistics. It is served here without the fonts and with a `fetch` that knows local hosts only.
"""

import re
import threading
from dataclasses import dataclass
from http.client import HTTPConnection
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.metadata import version

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

ETAG = f'"rerun-{version("rerun-sdk")}-1"'


@dataclass(frozen=True)
class Asset:
    """One file of the viewer."""

    body: bytes
    headers: dict[str, str]


def local_page(html: bytes) -> bytes:
    """The viewer's page without its requests to the outside."""
    return FONTS.sub(b"", html).replace(b"<head>", b"<head>\n" + LOCAL_ONLY, 1)


def serve(host: str, port: int, upstream: int) -> ThreadingHTTPServer:
    """Serve the viewer that listens on 127.0.0.1:`upstream`, from a thread, until `shutdown`.

    Raises OSError when the port is taken.
    """
    assets: dict[str, Asset] = {}

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            path = self.path.partition("?")[0]
            if self.headers.get("If-None-Match") == ETAG:
                self.send_response(304)
                self.end_headers()
                return
            try:
                asset = assets.get(path) or assets.setdefault(path, _fetch(upstream, path))
            except OSError:
                self.send_error(502, "the Rerun hub does not answer")
                return
            self.send_response(200)
            for name, value in asset.headers.items():
                self.send_header(name, value)
            self.end_headers()
            self.wfile.write(asset.body)

        def log_message(self, format: str, *args: object) -> None:
            """Requests are not worth a line each."""

    server = ThreadingHTTPServer((host, port), Handler)
    server.daemon_threads = True
    threading.Thread(target=server.serve_forever, name="rerun-page", daemon=True).start()
    return server


def _fetch(upstream: int, path: str) -> Asset:
    connection = HTTPConnection("127.0.0.1", upstream, timeout=30)
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
