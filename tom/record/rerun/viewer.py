"""The files of Rerun's web viewer, for a page of this machine.

They are taken from Rerun's own server, which runs only for that: it answers every page and program
that reaches its ports, and has no option against this. The page in Rerun's wheel loads fonts, asks
for the newest release and sends usage statistics. Here it is without the fonts, and its `fetch` is
restricted to the server from which it comes.
"""

import os
import re
import subprocess
import time
from contextlib import suppress
from http.client import HTTPConnection
from pathlib import Path
from tempfile import TemporaryDirectory

import rerun_cli

from tom.machine import processes
from tom.machine.address import free_port

START_S = 30.0
STOP_S = 3.0
HOST = "127.0.0.1"
PAGE = "index.html"
FILES = (PAGE, "re_viewer.js", "re_viewer_bg.wasm", "favicon.ico", "sw.js")

FONTS = re.compile(rb"<link[^>]*fonts\.(?:googleapis|gstatic)\.com[^>]*>")

LOCAL_ONLY = b"""<script>
  // Neither a version check nor statistics: other hosts are never asked, and never answer.
  const fetchAnywhere = window.fetch.bind(window);
  window.fetch = (target, options) => {
    const url = new URL(target instanceof Request ? target.url : target, location.href);
    return url.origin === location.origin ? fetchAnywhere(target, options) : new Promise(() => {});
  };
  // The viewer takes whole addresses only.
  const here = new URL(location.href);
  const urls = here.searchParams.getAll("url").map((url) => new URL(url, here).href);
  here.searchParams.delete("url");
  for (const url of urls) here.searchParams.append("url", url);
  history.replaceState(null, "", here);
</script>
"""


def binary() -> Path:
    """The path of Rerun's program, because killing the wheel's Python wrapper would orphan it."""
    return Path(rerun_cli.__file__).with_name("rerun")


def unpack(folder: Path) -> None:
    """Write the viewer's `FILES` into a new folder. Raises OSError if Rerun does not start."""
    deadline = time.monotonic() + START_S
    port = free_port(HOST)
    options = ["--serve-web", "--bind", HOST, "--port", str(free_port(HOST))]
    command = [str(binary()), *options, "--web-viewer-port", str(port)]
    with TemporaryDirectory(prefix="tom-rerun-", dir=folder.parent) as work:
        settings, files = Path(work, "settings"), Path(work, "files")
        files.mkdir()
        rerun = processes.start(command, None, without_analytics(settings), session=False)
        try:
            page = b""
            while not page:
                if rerun.poll() is not None or time.monotonic() > deadline:
                    raise TimeoutError(f"{command[0]} does not start")
                time.sleep(0.05)
                with suppress(OSError):
                    page = _fetch(port, "")
            for name in FILES:
                (files / name).write_bytes(page if name == PAGE else _fetch(port, name))
        finally:
            processes.stop([rerun], STOP_S)
        (files / PAGE).write_bytes(local_page(page))
        files.rename(folder)


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


def _fetch(port: int, name: str) -> bytes:
    """A file of Rerun's own server. Raises OSError if it does not answer or has no such file."""
    connection = HTTPConnection(HOST, port, timeout=30)
    try:
        connection.request("GET", f"/{name}")
        answer = connection.getresponse()
        if answer.status != 200:
            raise OSError(f"{name}: {answer.status}")
        return answer.read()
    finally:
        connection.close()
