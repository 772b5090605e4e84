"""Addresses of the studio's servers, and which of a store's files they give out."""

import asyncio
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import pytest
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.types import ASGIApp, Message
from studio_runs import ROAD_TOM

from app.guard import Guard
from app.links import Links
from app.servers.pages import EPISODE, options, recording_path, routes, viewer_origin
from app.theme import Mode

MODES: tuple[Mode, ...] = ("dark", "light")
LINKS = Links(store="/runs", port=8600, rerun_port=9090, viser_port=8080, control="/c", key="k")


def test_links_survive_the_environment(monkeypatch) -> None:
    for name, value in LINKS.environment().items():
        monkeypatch.setenv(name, value)
    assert Links.from_environment() == LINKS


def test_the_live_viewer_reads_one_run_from_the_hub() -> None:
    address = urlsplit(LINKS.rerun_live("studio.local", "a b", "dark"))
    assert address.netloc == "studio.local:9090"
    query = parse_qs(address.query)
    assert query["url"] == ["http://studio.local:9090/live/a%20b.rrd"]
    assert query["theme"] == ["dark"]


def test_a_resumed_run_has_several_recordings() -> None:
    names = ["run.rrd", "run-2.rrd"]
    query = parse_qs(urlsplit(LINKS.rerun_files("localhost", "a", names, "light")).query)
    assert query["url"] == [f"http://localhost:8600/rrd/a/{name}" for name in names]


def test_an_episode_is_shown_in_rerun() -> None:
    query = parse_qs(urlsplit(LINKS.rerun_episode("localhost", "a b", 400, 1, 25, "dark")).query)
    [address] = query["url"]
    assert address == "http://localhost:8600/rrd/a%20b/episode-400-1-25.rrd"
    wanted = EPISODE.fullmatch(address.rpartition("/")[2])
    assert wanted is not None
    assert wanted.groups() == ("400", "1", "25")


def test_a_viser_frame_carries_the_name_of_its_page() -> None:
    query = parse_qs(urlsplit(LINKS.viser("localhost", "abc", "light")).query)
    assert query["websocket"] == ["ws://localhost:8080/abc"]


def test_a_viser_frame_is_dark_before_its_server_says_so() -> None:
    dark, light = (urlsplit(LINKS.viser("localhost", "abc", mode)).query for mode in MODES)
    assert dark == f"{light}&darkMode"


def test_a_wildcard_is_reached_by_the_loopback() -> None:
    links = Links(host="0.0.0.0", port=1)
    assert links.address == "http://127.0.0.1:1"
    assert options(LINKS)["browser.gatherUsageStats"] is False


def test_ipv6_stands_in_brackets() -> None:
    links = Links(host="::1", port=1)
    assert links.address == "http://[::1]:1"
    assert links.local_only


def test_only_recordings_are_given_out(store: Path) -> None:
    found = recording_path(str(store), ROAD_TOM, "run.rrd")
    assert found == store / ROAD_TOM / "run.rrd"
    for run, name in (
        (ROAD_TOM, "config.json"),
        (ROAD_TOM, "../road-mle/config.json"),
        ("..", "run.rrd"),
        ("none", "run.rrd"),
    ):
        assert recording_path(str(store), run, name) is None


def test_a_recording_that_is_a_link_is_not_followed(store: Path, tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "run.rrd").symlink_to(store / ROAD_TOM / "run.rrd")
    assert recording_path(str(tmp_path), "run", "run.rrd") is None


@pytest.mark.parametrize(
    ("bound", "host", "code"),
    [
        ("127.0.0.1", "localhost:8600", 200),
        ("127.0.0.1", "LOCALHOST:8600", 200),
        ("127.0.0.1", "localhost:8601", 403),
        ("127.0.0.1", "localhost", 403),
        ("127.0.0.1", "evil.example:8600", 403),
        ("127.0.0.1", "", 403),
        ("127.0.0.1", "[", 403),
        ("::1", "[::1]:8600", 200),
        ("0.0.0.0", "any.name:8600", 200),
    ],
)
def test_only_under_its_own_names_it_gives_out_what_it_holds(
    bound: str, host: str, code: int, store: Path
) -> None:
    links = Links(store=str(store), host=bound, port=8600)
    guarded = Guard(Starlette(routes=routes(links)), links)
    for path in (f"/rrd/{ROAD_TOM}/run.rrd", "/api/health", "/", "/compare"):
        assert answered(guarded, path, host) == code, path
    for path in ("/v/none", "/reports/none", "/_stcore/metrics"):
        assert answered(guarded, path, host) == (404 if code == 200 else code), path


def answered(served: ASGIApp, path: str, host: str) -> int:
    """The code with which a server answers a request."""
    said: list[Message] = []

    async def send(message: Message) -> None:
        said.append(message)

    async def receive() -> Message:
        return {"type": "http.disconnect"}

    async def ask() -> None:
        asked = {"type": "http", "method": "GET", "path": path, "query_string": b""}
        await served({**asked, "headers": [(b"host", host.encode())]}, receive, send)

    asyncio.run(ask())
    return said[0]["status"]


@pytest.mark.parametrize(
    ("asked", "target"), [(b"", "/"), (b"runs=a&runs=b%2F1&x=%26", "/?runs=a&runs=b%2F1&x=%26")]
)
def test_the_first_page_has_the_address_that_its_name_suggests_too(
    asked: bytes, target: str
) -> None:
    [route] = [route for route in routes(LINKS) if route.path == "/live"]
    scope = {"type": "http", "headers": [], "path": "/live", "query_string": asked}
    answer = route.endpoint(Request({**scope, "scheme": "http", "server": ("127.0.0.1", 8600)}))
    assert answer.status_code == 307
    assert answer.headers["location"] == target


def test_only_the_viewers_page_may_read_recordings() -> None:
    for host, origin in (
        ("studio.local", "http://studio.local:9090"),
        ("[::1]", "http://[::1]:9090"),
    ):
        headers = [(b"host", f"{host}:8600".encode())]
        request = Request({"type": "http", "headers": headers, "path": "/", "scheme": "http"})
        assert viewer_origin(request, LINKS) == origin
