"""Addresses of the studio's servers, and what they give out: a store's files, drawn figures."""

import asyncio
import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from urllib.parse import parse_qs, urljoin, urlsplit

import pytest
from starlette.applications import Starlette
from starlette.datastructures import Headers
from starlette.types import ASGIApp, Message
from studio_runs import ROAD_TOM

from app.figures import paper
from app.guard import Guard
from app.links import Links
from app.servers.pages import LARGEST_FIGURE, options, routes
from app.servers.viewers import EPISODE, recording_path

LINKS = Links(store="/runs", port=8600, base="/x/", folder="/f", key="k")
SERVED = Starlette(routes=routes(LINKS))


@pytest.mark.parametrize(
    "names", [["live.rrd"], ["run.rrd", "run-2.rrd"], ["episode-400-1-25.rrd"]]
)
def test_rerun_shows_recordings_that_lie_beside_its_page(names: list[str]) -> None:
    address = f"http://studio.local{LINKS.rerun('a b', names, 'dark')}"
    query = parse_qs(urlsplit(address).query)
    assert query["theme"] == ["dark"]
    recordings = [urlsplit(urljoin(address, url)).path for url in query["url"]]
    assert recordings == [f"/x/rrd/a%20b/{name}" for name in names]
    wanted = EPISODE.fullmatch(names[0])
    assert (wanted and wanted.groups()) in (None, ("400", "1", "25"))


def test_a_wildcard_is_reached_by_the_loopback() -> None:
    assert Links(host="0.0.0.0", port=1).address == "http://127.0.0.1:1"
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
        ("\x00", "run.rrd"),
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
        ("127.0.0.1", "localhost:8601", 200),  # another port of a tunnel
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
    for path in (f"/rrd/{ROAD_TOM}/run.rrd", "/api/health", "/", "/curves"):
        assert answered(guarded, path, host) == code, path
    for path in ("/v/none", "/reports/none", "/_stcore/metrics"):
        assert answered(guarded, path, host) == (404 if code == 200 else code), path


@pytest.mark.parametrize(
    ("host", "headers", "code"),
    [
        ("hub.example", {"sec-fetch-site": "same-origin"}, 200),
        ("hub.example", {"origin": "https://hub.example"}, 200),
        ("127.0.0.1:9999", {}, 200),  # a proxy of this machine
        ("127.0.0.1:9999", {"origin": "http://127.0.0.1:9999"}, 200),
        ("hub.example", {"sec-fetch-site": "cross-site", "sec-fetch-mode": "navigate"}, 200),
        ("hub.example", {"sec-fetch-site": "cross-site", "sec-fetch-mode": "no-cors"}, 403),
        ("hub.example", {"origin": "https://evil.example"}, 403),
        ("127.0.0.1:9999", {"origin": "http://127.0.0.1:8600"}, 403),
        # A name that was made to point here: browsers send no Sec-Fetch-Site over plain http.
        ("evil.example:8600", {}, 403),
        ("evil.example:8600", {"origin": "http://evil.example:8600"}, 403),
    ],
)
def test_behind_a_proxy_it_answers_pages_of_a_secure_address(
    host: str, headers: dict[str, str], code: int
) -> None:
    guarded = Guard(SERVED, LINKS)
    for path in ("/x/api/health", "/x/", "/x/curves", "/curves"):  # some proxies take `/x` off
        assert answered(guarded, path, host, **headers) == code, path
    alone, root = (Guard(guarded._app, replace(LINKS, base=base)) for base in ("", "/"))
    assert answered(root, "/curves", host, **headers) == code
    if "127.0.0.1" not in host:
        assert answered(alone, "/curves", host, **headers) == 403


def test_the_path_of_a_proxy_gets_the_slash_that_relative_addresses_need() -> None:
    guarded = Guard(SERVED, LINKS)
    code, headers, _ = reply(guarded, "GET", "/x")
    assert (code, headers["location"]) == (307, "/x/")
    assert answered(guarded, "/xy/curves") == 404


def answered(served: ASGIApp, path: str, host: str = "localhost:8600", **headers: str) -> int:
    """The code with which a server answers a request."""
    return reply(served, "GET", path, host, b"", **headers)[0]


def reply(
    served: ASGIApp,
    method: str,
    path: str,
    host: str = "localhost:8600",
    body: bytes = b"",
    **more: str,
) -> tuple[int, Mapping[str, str], bytes]:
    """Code, headers and body of an answer."""
    said: list[Message] = []
    got = [{"type": "http.request", "body": body}, {"type": "http.disconnect"}]

    async def send(message: Message) -> None:
        said.append(message)

    async def receive() -> Message:
        return got.pop(0)

    async def ask() -> None:
        at, _, query = path.partition("?")
        headers = {"host": host, "content-length": str(len(body)), **more}
        asked = {"type": "http", "method": method, "path": at, "query_string": query.encode()}
        given = [(name.encode(), value.encode()) for name, value in headers.items()]
        await served({**asked, "headers": given}, receive, send)

    asyncio.run(ask())
    content = b"".join(message.get("body", b"") for message in said)
    return said[0]["status"], Headers(raw=said[0]["headers"]), content


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("/live", "/"),
        ("/live?run=a&x=%26", "/?run=a&x=%26"),
        ("/compare?env=a&text=b&show=Statistics", "/curves?task=a&find=b&part=Statistics"),
        ("/compare?show=Side+by+side&side=a", "/replays?part=Side+by+side&side=a"),
        ("/compare?metric=eval%2Freturn&hide=TOM", "/curves?panel=eval%2Freturn&hide=TOM"),
        ("/weights?run=a&step=30&scale=as+they+are", "/attention?run=a&step=30&scale=as+they+are"),
        ("/regions?run=a", "/attention?run=a"),
        ("/probe?at=3", "/attention?part=Every+learner+on+one+buffer&step=3"),
        ("/road?run=a", "/attention?task=road-and-rocks&run=a"),
        ("/cinema?run=a", "/replays?part=Film&run=a"),
        ("/studies?study=road", "/findings?study=road"),
    ],
)  # fmt: skip
def test_an_address_of_an_older_studio_leads_to_todays_page(old: str, new: str) -> None:
    code, headers, _ = reply(SERVED, "GET", old)
    assert (code, urljoin(old, headers["location"])) == (307, new)
    assert answered(SERVED, urlsplit(new).path) == 200


HUGE = {"range": [0, 1e6], "type": "log", "domain": [0, 1], "title": "", "tickvals": None}


def a_figure(**more: object) -> bytes:
    """What the browser sends of a line through two points."""
    axis = {"range": [0, 2], "type": "linear", "domain": [0, 1], "title": "", "tickvals": None,
            "ticktext": None}  # fmt: skip
    line = {
        "axes": "xy", "type": "scatter", "name": "TOM", "x": [0, 2], "y": [0, 1], "z": None,
        "mode": "lines", "opacity": 1, "colour": "#c3521f", "width": 2, "dash": "solid",
        "shape": "linear", "symbol": "circle", "size": 4, "fill": None, "showlegend": True,
        "bars": None, "marks": None,
        "colorscale": None, "zmin": None, "zmax": None, "ticks": None,
    }  # fmt: skip
    shown = {"traces": [line], "axes": {"xy": {"x": axis, "y": axis}}, "annotations": [],
             "shapes": [], "legend": True, "ratio": 0.6}  # fmt: skip
    return json.dumps({**shown, **more}).encode()


def figure(query: str, body: bytes, **more: str) -> tuple[int, Mapping[str, str], bytes]:
    return reply(SERVED, "POST", f"/api/figure?{query}", body=body, **more)


def test_a_figure_for_a_paper_is_a_file() -> None:
    code, headers, content = figure("kind=pdf&width=one", a_figure())
    assert (code, headers["content-type"]) == (200, paper.KINDS["pdf"])
    assert content.startswith(b"%PDF")


@pytest.mark.parametrize(
    ("query", "body"),
    [
        ("kind=pdf&width=one", b"nonsense"),
        ("kind=pdf&width=one", b"[" * 100_000),
        ("kind=pdf&width=one", a_figure(axes={})),
        ("kind=pdf&width=one", a_figure(axes={"xy": {"x": HUGE, "y": HUGE}})),
        ("kind=pdf&width=1000", a_figure()),
        ("kind=exe&width=one", a_figure()),
        ("", a_figure()),
    ],
)
def test_what_is_no_figure_is_refused(query: str, body: bytes) -> None:
    assert figure(query, body)[0] == 400


@pytest.mark.parametrize("length", [str(LARGEST_FIGURE + 1), "many", ""])
def test_a_figure_that_is_too_large_or_of_no_length_is_not_read(length: str) -> None:
    code, _, content = figure("kind=pdf&width=one", a_figure(), **{"content-length": length})
    assert code == 400
    assert not content.startswith(b"%PDF")
