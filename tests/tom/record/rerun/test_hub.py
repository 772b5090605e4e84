"""The hub as a launcher runs it: a page that stays local, and an end without orphans."""

import json
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
from kernel import descendants, listening

from tom.record.rerun import hub


def test_the_page_asks_no_other_host():
    page = b"""<html><head>
      <link rel="preconnect" href="https://fonts.gstatic.com" crossorigin />
      <link
        href="https://fonts.googleapis.com/css2?family=Inter" rel="stylesheet" />
      <link rel="icon" href="favicon.ico" /></head></html>"""
    local = hub.local_page(page)
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
def hub_at(host: str, store: Path) -> Iterator[tuple[subprocess.Popen[bytes], int]]:
    port = hub.free_port(host)
    process = subprocess.Popen(hub.command(host, port, store), stderr=subprocess.DEVNULL)
    deadline = time.monotonic() + 60
    try:
        while not _up(port, host):
            assert process.poll() is None
            assert time.monotonic() < deadline
            time.sleep(0.05)
        yield process, port
    finally:
        process.kill()
        process.wait()


@pytest.fixture
def running(tmp_path: Path) -> Iterator[tuple[subprocess.Popen[bytes], int]]:
    with hub_at("127.0.0.1", tmp_path) as found:
        yield found


def _up(port: int, host: str) -> bool:
    try:
        return get(port, host=host)[0] == 200
    except OSError:
        return False


@pytest.mark.skipif(sys.platform != "linux", reason="others have no second loopback address")
def test_a_hub_on_another_address_listens_there_alone(tmp_path: Path):
    with hub_at("127.0.0.2", tmp_path) as (process, port):
        assert get(port, host="127.0.0.2")[0] == 200
        assert listening({process.pid, *descendants(process.pid)}) == {("0200007F", port)}


@pytest.mark.skipif(not socket.has_ipv6, reason="no IPv6")
def test_a_page_is_served_on_ipv6_under_its_own_names():
    server = hub.ViewerServer(
        "::1", hub.free_port("::1"), {}, lambda run_id: iter([run_id.encode()])
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


@pytest.mark.fault
@pytest.mark.quick
def test_a_run_that_cannot_be_shown__is_an_error_and_no_empty_recording():
    def no_recording(run_id: str) -> Iterator[bytes]:
        yield bytes([int(run_id)])  # raises at the first look

    server = hub.ViewerServer("127.0.0.1", hub.free_port("127.0.0.1"), {}, no_recording)
    server.start()
    try:
        assert get(server.server_port, "/live/7.rrd")[:2] == (200, b"\x07")
        status, words, _ = get(server.server_port, "/live/seven.rrd")
        assert (status, words) == (500, b"this run cannot be shown")
    finally:
        server.shutdown()
        server.server_close()


def test_the_hub_serves_the_viewer_and_leaves_no_server_of_reruns(running):
    process, port = running
    status, page, headers = get(port)
    assert status == 200
    assert headers["Content-Type"] == "text/html"
    assert b"googleapis" not in page
    assert re.search(rb"<script>.*window.fetch = .*</script>", page, re.DOTALL)
    status, script, headers = get(port, "/re_viewer.js")
    assert (status, len(script)) == (200, int(headers["Content-Length"]))
    assert get(port, "/re_viewer.js", **{"If-None-Match": headers["ETag"]})[:2] == (304, b"")
    assert get(port, "/../secret")[0] == 404
    assert get(port, Host="evil.example:80")[0] == 403
    assert get(port, "/live/nothing.rrd")[0] == 404
    assert get(port, "/live/..%2Fsecret.rrd")[0] == 404
    assert descendants(process.pid) == set()
    assert listening({process.pid}) == {("0100007F", port)}
    process.send_signal(signal.SIGTERM)
    assert process.wait(10) == 0


def test_rerun_sends_no_statistics(tmp_path: Path):
    settings = Path(hub.without_analytics(tmp_path)["XDG_CONFIG_HOME"]) / "rerun"
    assert json.loads((settings / "analytics.json").read_text())["analytics_enabled"] is False
