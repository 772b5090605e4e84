"""The studio: runs that vanish, hostile words, several studios, an end without orphans."""

import asyncio
import json
import re
import shutil
import signal
from importlib import import_module
from pathlib import Path
from threading import Event

import pytest
import streamlit as st
from faults import config, wait_until
from kernel import LOOPBACK, alive, descendants, listening
from servers import (
    answers,
    command_of,
    is_taken,
    studio,
)
from streamlit.runtime.context import ContextProxy
from streamlit.testing.v1 import AppTest

from app.guard import KEY
from app.links import Links
from app.router import VIEWS
from app.servers import launcher
from app.servers.viewers import recording_path
from tom.errors import UserError
from tom.record import Store, manage
from tom.record.rerun import viewer
from tom.training.presets import resolve
from tom.training.run import train

pytestmark = pytest.mark.fault

PARTS = {
    "curves": ("Statistics", "Settings", "Runs"),
    "attention": ("Every learner on one buffer",),
    "replays": ("Side by side", "Film", "Rerun"),
}
"""of pages: their parts but for the first"""
PAGES = [(view.name, part) for view in VIEWS for part in ("", *PARTS.get(view.name, ()))]
every_page = pytest.mark.parametrize(("name", "part"), PAGES)
AS_TEXT = ("tom_runlist", "tom_frame")
"""parts that make text of what they are given: the runs, and notices of ended trainings"""
HOSTILE = "<img src=http://evil.example/x.png onerror=alert(1)>![x](http://evil.example/y.png)"
ESCAPES = ("../../etc/passwd", "..", "a/../../b", "/etc/passwd", "\x00", HOSTILE, "' OR 1=1 --")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store with two pendulum runs and one of road-and-rocks."""
    store = Store(tmp_path_factory.mktemp("made") / "store")
    train(config("tom"), store, "tom", rerun=True)
    train(config("mle"), store, "mle", rerun=False)
    given = {"steps": 60, "fit_every": 30, "random_transitions": 2000}
    train(resolve("road-and-rocks", "tom", "smoke", given), store, "road", rerun=False)
    return store.path


@pytest.fixture
def store(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """A copy of it that the pages of this process show."""
    path = shutil.copytree(made, tmp_path / "store")
    for name, value in Links(store=str(path), key="key").environment().items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr(ContextProxy, "headers", {KEY: "key"})  # AppTest sends no request
    yield path
    st.cache_data.clear()
    st.cache_resource.clear()


def page(name: str, part: str, **query: str) -> AppTest:
    """A part of a page of the studio as a browser with this address gets it."""
    script = f"""
from app.parts import address
from app.router import VIEWS, draw

[view] = [view for view in VIEWS if view.name == {name!r}]
address.visit(view.PATH)
draw(view.page)
address.write()
"""
    app = AppTest.from_string(script, default_timeout=60)
    for key, value in (({"part": part} if part else {}) | query).items():
        app.query_params[key] = value
    return app.run()


def harmless(app: AppTest) -> None:
    """Nothing on the page is markup that came from outside."""
    assert not app.exception, app.exception[0].message
    heads = (*app.header, *app.subheader)
    shown = (*app.markdown, *app.caption, *app.warning, *app.info, *app.error, *heads)
    for element in shown:
        assert not re.search(r"(?<!\\)!\[x|(?<!\\)<img", element.value), element.value
        assert not re.search(r"(?<![\\`])\]\(http://evil", element.value), element.value
    for block in app.get("html"):
        assert "<img" not in block.proto.body
    for part in app.get("bidi_component"):
        if part.proto.component_name not in AS_TEXT:
            content = json.loads(part.proto.json)
            # Of a chart only the figure: its label and its caption are an attribute and a text.
            assert "<img" not in json.dumps(content.get("figure", content))


@every_page
@pytest.mark.parametrize("chosen", ["tom", "road"])
def test_a_page_open_while_its_run_is_deleted__goes_on_with_the_runs_that_are_left(
    name: str, part: str, chosen: str, store: Path
):
    app = page(name, part, run=chosen)
    assert not app.exception
    shutil.rmtree(store / chosen)
    app.run()
    assert not app.exception, app.exception[0].message
    shutil.rmtree(store)
    app.run()
    assert not app.exception, app.exception[0].message


@every_page
@pytest.mark.parametrize("copied", ["tom", "road"])
def test_hostile_words_in_names_notes_settings_and_notices__are_shown_as_plain_words(
    name: str, part: str, copied: str, store: Path
):
    bad = shutil.copytree(store / copied, store / "bad")
    content = json.loads((bad / "config.json").read_text())
    for key in ("learner", "preset", "command", "git_commit", "created"):
        content[key] = HOSTILE
    content["config"]["device"] = content["config"]["learner"] = HOSTILE
    (bad / "config.json").write_text(json.dumps(content))
    status = json.loads((bad / "status.json").read_text())
    hostile = {"state": "failed", "phase": HOSTILE, "reason": HOSTILE, "warnings": [HOSTILE]}
    (bad / "status.json").write_text(json.dumps({**status, **hostile}))
    (bad / "notices.jsonl").write_text(
        json.dumps({"env_step": 1, "code": HOSTILE, "message": HOSTILE}) + "\n"
    )
    with (bad / "metrics.jsonl").open("a") as file:
        file.write(json.dumps({"env_step": 10_000, HOSTILE: 1.0}) + "\n")
    manage.label(Store(store), "bad", note=HOSTILE)
    try:
        manage.label(Store(store), "bad", name=HOSTILE)
        manage.label(Store(store), "bad", add=[HOSTILE])
    except UserError:
        pass  # a name or tag that is not allowed is as good as a harmless one
    for query in ({}, {"run": "bad"}, {"run": "bad", "panel": HOSTILE}):
        harmless(page(name, part, **query))


@every_page
def test_hostile_query_parameters__change_nothing_and_read_nothing_outside(
    name: str, part: str, store: Path, tmp_path: Path
):
    shutil.copytree(store / "tom", tmp_path / "outside")
    kept = page(name, part).session_state["address: keeping"].keys() - {"part"}
    assert {"run", "task", "find"} <= kept
    for value in (*ESCAPES, "../outside"):
        app = page(name, part, **dict.fromkeys([*kept, "frame"], value))
        harmless(app)
        assert "outside" not in " ".join(str(m.value) for m in app.markdown)


@pytest.mark.parametrize("run_id", [*ESCAPES, "..%2f..", "store", "%00"])
def test_hostile_run_ids_in_addresses__give_out_no_file(run_id: str, store: Path):
    for name in ("run.rrd", "../tom/run.rrd", "config.json", "/etc/passwd", run_id):
        assert recording_path(str(store), run_id, name) is None
    for name in ("../mle/config.json", "config.json", "..", "checkpoint/000000240/state.pt"):
        assert recording_path(str(store), "tom", name) is None


def test_two_studios_on_one_store__both_serve_and_sigterm_leaves_no_orphan(made: Path):
    with studio(made) as (first, port), studio(made) as (second, other):
        assert port != other
        assert answers(port, "/api/health")
        assert answers(other, "/api/health")
        children = {s.pid: descendants(s.pid) for s in (first, second)}
        first.send_signal(signal.SIGTERM)
        assert first.wait(30) == 0
        wait_until(lambda: not any(map(alive, children[first.pid])))
        assert answers(other, "/api/health")
        assert all(map(alive, children[second.pid]))
    wait_until(lambda: not any(map(alive, children[second.pid])))
    assert not is_taken(port)
    assert not is_taken(other)


def test_a_studio_killed_with_sigkill__leaves_no_orphan(made: Path):
    with studio(made) as (process, port):
        children = descendants(process.pid)
        process.kill()
        process.wait()
        wait_until(lambda: not any(map(alive, children)), seconds=20)
        assert not is_taken(port)


def test_servers_of_a_studio__listen_on_one_port_of_the_loopback_and_send_no_statistics(
    made: Path,
):
    with studio(made) as (process, port):
        children = descendants(process.pid)
        assert {address for address, _ in listening(children)} <= LOOPBACK
        assert {own for _, own in listening(children)} == {port}
        assert not [pid for pid in children if command_of(pid).startswith(str(viewer.binary()))]
        assert gathers_statistics(port) is False


def gathers_statistics(port: int) -> bool:
    """What a running Streamlit tells each browser about usage statistics."""
    forward = import_module("streamlit.proto.ForwardMsg_pb2")
    back = import_module("streamlit.proto.BackMsg_pb2")
    client = import_module("websockets.asyncio.client")

    async def ask() -> bool:
        address = f"ws://127.0.0.1:{port}/_stcore/stream"
        origin = f"http://127.0.0.1:{port}"
        async with client.connect(address, origin=origin, subprotocols=["streamlit"]) as browser:
            message = back.BackMsg()
            message.rerun_script.query_string = ""
            await browser.send(message.SerializeToString())
            while True:
                answer = forward.ForwardMsg()
                answer.ParseFromString(await asyncio.wait_for(browser.recv(), 30))
                if answer.WhichOneof("type") == "new_session":
                    return answer.new_session.config.gather_usage_stats

    return asyncio.run(ask())


@pytest.mark.quick
@pytest.mark.parametrize("host", ["127.0.0.1", "0.0.0.0"])
def test_a_host_that_others_reach__is_explicit_and_warns_before_anything_starts(
    host: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    stopping = Event()
    stopping.set()
    with launcher.serving(Links(str(tmp_path), host), stopping) as (links, running):
        assert (links.host, running) == (host, None)
        warned = "reachable from other machines" in capsys.readouterr().err
    assert warned == (host != "127.0.0.1")
