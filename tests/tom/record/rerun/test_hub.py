"""The hub as a launcher runs it: a page that stays local, and an end without orphans."""

import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from http.client import HTTPConnection
from pathlib import Path

import pytest

from tom.record.rerun import hub, web


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


def get(
    port: int, path: str = "/", host: str = "127.0.0.1", **headers: str
) -> tuple[int, bytes, dict[str, str]]:
    connection = HTTPConnection(host, port, timeout=10)
    connection.request("GET", path, headers=headers)
    answer = connection.getresponse()
    return answer.status, answer.read(), dict(answer.getheaders())


@contextmanager
def hub_at(host: str, store: Path) -> Iterator[tuple[subprocess.Popen[bytes], int, int]]:
    port, web_port = (hub.free_port(host) for _ in range(2))
    process = subprocess.Popen(hub.command(host, port, web_port, store), stderr=subprocess.DEVNULL)
    deadline = time.monotonic() + 60
    try:
        while not _up(web_port, host):
            assert process.poll() is None
            assert time.monotonic() < deadline
            time.sleep(0.05)
        yield process, port, web_port
    finally:
        process.kill()
        process.wait()


@pytest.fixture
def running(tmp_path: Path) -> Iterator[tuple[subprocess.Popen[bytes], int, int]]:
    with hub_at("127.0.0.1", tmp_path) as found:
        yield found


def _up(port: int, host: str) -> bool:
    try:
        return get(port, host=host)[0] == 200
    except OSError:
        return False


@pytest.mark.skipif(sys.platform != "linux", reason="others have no second loopback address")
def test_a_hub_on_another_address_shows_what_trains(tmp_path: Path):
    with hub_at("127.0.0.2", tmp_path) as (_, port, web_port):
        assert get(web_port, host="127.0.0.2")[0] == 200
        deadline = time.monotonic() + 60
        while f"0200007F:{port:04X}" not in dialled():  # by the hub's feeder
            assert time.monotonic() < deadline
            time.sleep(0.02)


def dialled() -> set[str]:
    """The far ends of all connections, address and port as the kernel writes them."""
    return {line.split()[2] for line in Path("/proc/net/tcp").read_text().splitlines()}


@pytest.mark.skipif(not socket.has_ipv6, reason="no IPv6")
def test_a_page_is_served_on_ipv6_under_its_own_names():
    server = web.Server(
        "::1", hub.free_port("::1"), ("::1", 0), lambda run_id: iter([run_id.encode()])
    )
    server.start()
    port = server.server_port
    try:
        assert get(port, "/live/a.rrd", host="::1")[:2] == (200, b"a")
        assert get(port, "/live/a.rrd", host="::1", Host=f"localhost:{port}")[0] == 200
        assert get(port, "/live/a.rrd", host="::1", Host=f"evil.example:{port}")[0] == 403
    finally:
        server.shutdown()
        server.server_close()


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
