"""The hub as a launcher runs it: a page that stays local, and an end without orphans."""

import os
import re
import signal
import subprocess
import time
from collections.abc import Iterator
from http.client import HTTPConnection
from pathlib import Path

import pytest

from tom.record import hub, web


def test_the_page_asks_no_other_host():
    page = b"""<html><head>
      <link rel="preconnect" href="https://fonts.gstatic.com" crossorigin />
      <link
        href="https://fonts.googleapis.com/css2?family=Inter" rel="stylesheet" />
      <link rel="icon" href="favicon.ico" /></head></html>"""
    local = web.local_page(page)
    assert b"fonts." not in local
    assert b"favicon.ico" in local
    assert local.index(b"window.fetch =") < local.index(b"favicon.ico")


def get(port: int, path: str = "/", **headers: str) -> tuple[int, bytes, dict[str, str]]:
    connection = HTTPConnection("127.0.0.1", port, timeout=10)
    connection.request("GET", path, headers=headers)
    answer = connection.getresponse()
    return answer.status, answer.read(), dict(answer.getheaders())


@pytest.fixture
def running(tmp_path: Path) -> Iterator[tuple[subprocess.Popen[bytes], int, int]]:
    port, web_port = (hub.free_port("127.0.0.1") for _ in range(2))
    process = subprocess.Popen(
        hub.command("127.0.0.1", port, web_port, tmp_path), stderr=subprocess.DEVNULL
    )
    deadline = time.monotonic() + 60
    while not _up(web_port):
        assert process.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.05)
    yield process, port, web_port
    process.kill()
    process.wait()


def _up(port: int) -> bool:
    try:
        return get(port)[0] == 200
    except OSError:
        return False


def test_the_hub_serves_the_viewer_and_takes_its_child_along(running):
    process, _, web_port = running
    status, page, headers = get(web_port)
    assert status == 200
    assert headers["Content-Type"] == "text/html"
    assert b"googleapis" not in page
    assert re.search(rb"<script>.*window.fetch = .*</script>", page, re.DOTALL)
    status, script, headers = get(web_port, "/re_viewer.js")
    assert (status, len(script)) == (200, int(headers["Content-Length"]))
    assert get(web_port, "/re_viewer.js", **{"If-None-Match": headers["ETag"]})[:2] == (304, b"")
    assert get(web_port, "/../secret")[0] in (404, 502)
    assert get(web_port, Host="evil.example:80")[0] == 403
    assert get(web_port, "/live/nothing.rrd")[0] == 404
    assert get(web_port, "/live/..%2Fsecret.rrd")[0] == 404
    [child] = _children(process.pid)
    process.send_signal(signal.SIGTERM)
    assert process.wait(10) == 0
    assert not _running(child)


def _children(pid: int) -> list[int]:
    listed = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    return [int(child) for child in listed]


def _running(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True
