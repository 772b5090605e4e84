"""Addresses of the studio's servers, and which of a store's files they give out."""

from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import pytest
from starlette.requests import Request
from studio_runs import ROAD_TOM

from app.links import Links
from app.servers.pages import EPISODE, options, recording_path, routes, viewer_origin

LINKS = Links(
    store="/runs", port=8600, rerun_port=9876, rerun_web_port=9090, viser_port=8080, control="/c"
)


def test_links_survive_the_environment(monkeypatch) -> None:
    for name, value in LINKS.environment().items():
        monkeypatch.setenv(name, value)
    assert Links.from_environment() == LINKS


def test_the_live_viewer_listens_to_the_hub() -> None:
    address = urlsplit(LINKS.rerun_live("studio.local", "dark"))
    assert address.netloc == "studio.local:9090"
    query = parse_qs(address.query)
    assert query["url"] == ["rerun+http://studio.local:9876/proxy"]
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
    query = parse_qs(urlsplit(LINKS.viser("localhost", "abc")).query)
    assert query["websocket"] == ["ws://localhost:8080/abc"]


def test_a_wildcard_is_reached_by_the_loopback() -> None:
    links = Links(host="0.0.0.0", port=1)
    assert links.address == "http://127.0.0.1:1"
    assert options(links)["server.allowedHosts"] == []
    assert options(LINKS)["server.allowedHosts"] == ["127.0.0.1", "localhost", "127.0.0.1"]
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
    links = Links(store=str(store), host=bound)
    answers = {route.path: route.endpoint for route in routes(links)}
    params = {"run": ROAD_TOM, "name": "run.rrd", "code": "none", "study": "none"}
    codes = {}
    for path in ("/rrd/{run}/{name}", "/api/health", "/v/{code}", "/reports/{study}"):
        asked = {"headers": [(b"host", host.encode())], "path": path, "path_params": params}
        request = Request({"type": "http", "scheme": "http", "method": "GET", **asked})
        codes[path] = answers[path](request).status_code
    there = [codes.pop("/rrd/{run}/{name}"), codes.pop("/api/health")]
    assert there == [code, code]
    assert set(codes.values()) == {404 if code == 200 else code}


def test_only_the_viewers_page_may_read_recordings() -> None:
    for host, origin in (
        ("studio.local", "http://studio.local:9090"),
        ("[::1]", "http://[::1]:9090"),
    ):
        headers = [(b"host", f"{host}:8600".encode())]
        request = Request({"type": "http", "headers": headers, "path": "/", "scheme": "http"})
        assert viewer_origin(request, LINKS) == origin
