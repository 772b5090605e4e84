"""Doors of the studio: foreign pages and programs, replies that quote, frames, other names."""

import os
import stat
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing
from http.client import HTTPConnection
from pathlib import Path
from threading import Event

import pytest
from faults import config, wait_until
from kernel import descendants
from servers import command_of
from tabs import Tab, buttons, folds, stream
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect
from websockets.typing import Origin

from app.links import Links
from app.servers.launcher import serving
from tom.record import Store
from tom.training.run import train

pytestmark = pytest.mark.fault

SCRIPT = "<script>alert(1)<%2Fscript>"
SPLIT = f"x%0d%0aContent-Type:%20text%2Fhtml%0d%0aX-Evil:%20yes%0d%0a%0d%0a{SCRIPT}"


@pytest.fixture(scope="module")
def studio(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Links]:
    """A real studio of one finished run."""
    store = tmp_path_factory.mktemp("doors") / "store"
    train(config(), Store(store), "a", rerun=False)
    with serving(Links(str(store)), Event()) as (links, running):
        assert running
        yield links


def reply(port: int, path: str, **headers: str) -> tuple[int, str]:
    """The status of a GET with these headers, and all that is answered."""
    with closing(HTTPConnection("127.0.0.1", port, timeout=20)) as connection:
        connection.request("GET", path, headers=headers)
        answer = connection.getresponse()
        return answer.status, f"{answer.headers} {answer.read()}"


@pytest.mark.parametrize("at", ["rerun", "rrd/a", "v", "viser"])
def test_line_breaks_and_markup_in_an_address__come_back_in_no_reply(at: str, studio: Links):
    _, answer = reply(studio.port, f"/{at}/{SPLIT}")
    assert "x-evil:" not in answer.lower()
    assert "<script>alert" not in answer


@pytest.mark.parametrize(
    "origin",
    [
        "http://127.0.0.1:{other}",
        "http://localhost:{other}",
        "http://localhost:{port}",
        "https://127.0.0.1:{port}",
        "http://127.0.0.1",
        "http://evil.example:{port}",
        "null",
        None,
    ],
)
def test_a_page_of_another_origin__opens_no_socket_of_the_studio_nor_of_its_3d_server(
    origin: str | None, studio: Links
):
    asked = Origin(origin.format(port=studio.port, other=1)) if origin else None
    address = f"ws://127.0.0.1:{studio.port}/viser/page"
    for opened in (
        lambda: stream(studio, asked, studio.key),
        lambda: connect(address, origin=asked, proxy=None),
    ):
        with pytest.raises(InvalidStatus) as refused:
            opened()
        assert refused.value.response.status_code == 403
    connect(address, origin=Origin(f"http://127.0.0.1:{studio.port}"), proxy=None).close()


@pytest.mark.parametrize(
    "path", ["/", "/curves", "/viser/a/", "/rerun/", "/_stcore/metrics", "/_stcore/health"]
)
def test_a_name_that_was_made_to_point_here_and_a_foreign_page__are_told_nothing_by_the_studio(
    path: str, studio: Links
):
    parts = {"Sec-Fetch-Site": "same-site", "Sec-Fetch-Mode": "no-cors"}
    assert reply(studio.port, path)[0] == 200
    assert reply(studio.port, path, Host=f"evil.example:{studio.port}")[0] == 403
    assert reply(studio.port, path, **parts)[0] == 403
    assert reply(studio.port, path, **(parts | {"Sec-Fetch-Mode": "navigate"}))[0] == 200
    assert reply(studio.port, path, Origin="http://127.0.0.1:1")[0] == 403


def test_streamlits_cloud__may_send_no_message_to_a_page_that_it_opened(studio: Links):
    assert '"allowedOrigins":[]' in reply(studio.port, "/_stcore/host-config")[1]


def test_another_user_of_this_machine__cannot_open_the_socket_between_page_and_3d_server(
    studio: Links,
):
    folder = Path(studio.folder)
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    kept = [path for path in folder.iterdir() if path.is_file()]
    assert not [path for path in kept if studio.key in path.read_text(errors="replace")]


def test_the_key__stands_in_no_command_line(studio: Links):
    for pid in {os.getpid(), *descendants(os.getpid())}:
        assert studio.key not in command_of(pid)


def test_the_browser_that_the_studio_opens__gets_the_key_from_a_file_and_not_in_its_command_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    told, browser = tmp_path / "told", tmp_path / "browser"
    browser.write_text(f'#!/bin/sh\ncat "${{1#file://}}" > {told}.page; echo "$@" > {told}\n')
    browser.chmod(0o755)
    (tmp_path / "store").mkdir()
    monkeypatch.setenv("DISPLAY", ":99")
    monkeypatch.setenv("BROWSER", f"{browser} %s")
    command = [sys.executable, "-m", "app", "--store", str(tmp_path / "store")]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        opened = process.stdout.readline().split()[2]
        wait_until(told.exists)
        assert "#key=" in opened
        assert opened in Path(f"{told}.page").read_text()
        assert "key" not in told.read_text()
    finally:
        process.terminate()
        process.wait(60)


def test_the_studio_under_its_other_name__is_a_page_of_its_own(studio: Links):
    stream(studio, f"http://localhost:{studio.port}", host="localhost").close()


def test_a_page_without_the_key_that_sends_the_clicks_of_one_with_it__changes_nothing(
    studio: Links,
):
    views = Path(studio.store) / ".views"
    with Tab(studio, "curves", studio.key) as mine, Tab(studio, "curves") as other:
        link = buttons(mine.draw())["Make a short link"]
        assert buttons(other.draw()) == {}
        other.draw(trigger_value=link)
        assert not views.exists()
        mine.draw(trigger_value=link)
        assert len(list(views.iterdir())) == 1


@pytest.mark.parametrize("key", ["", "x", "wrong-key-of-the-very-same-length-as-a-key-"])
def test_a_page_with_a_wrong_key_or_none__starts_no_training(key: str, studio: Links):
    with Tab(studio, key=studio.key) as mine, Tab(studio, key=key) as other:
        fold = folds(mine.draw())["Start a training"]
        start = buttons(mine.draw(bool_value=fold))["Start"]
        other.draw()
        assert "Start" not in buttons(other.draw(bool_value=fold))
        other.draw(bool_value=fold, trigger_value=start)
    assert not [pid for pid in descendants(os.getpid()) if "tom train" in command_of(pid)]
    assert [run.run_id for run in Store(Path(studio.store)).runs()] == ["a"]
