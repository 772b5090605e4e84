"""The launcher: one address, errors in one line, and an end without orphans."""

import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from threading import Barrier, Event

import pytest
from kernel import LOOPBACK, alive, descendants, listening
from studio_runs import PENDULUM_TOM, ROAD_TOM

from app.__main__ import main
from app.servers import launcher
from app.servers.launcher import Studio, in_words, servers
from app.servers.processes import Server, free_port, is_free

START_S = 90


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_the_studio_serves_and_ends_without_orphans(store: Path, tmp_path: Path) -> None:
    (tmp_path / ".streamlit").mkdir()
    (tmp_path / ".streamlit" / "config.toml").write_text(
        '[server]\nbaseUrlPath = "x"\nsslCertFile = "/no.pem"\n[global]\ndevelopmentMode = true'
    )
    port = free_port("127.0.0.1")
    command = [sys.executable, "-m", "app", "--store", str(store), "--port", str(port)]
    studio = subprocess.Popen(
        [*command, "--no-browser"],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        cwd=tmp_path,
        env={**os.environ, "HOME": str(tmp_path)},
    )
    try:
        assert studio.stdout is not None
        line = studio.stdout.readline()
        tunnels = re.findall(r"-L (\d+):127\.0\.0\.1:(\d+)", studio.stdout.readline())
        assert f"http://127.0.0.1:{port}" in line, line
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/api/health", timeout=10) as answer:
            assert str(store) in answer.read().decode()
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/_stcore/health", timeout=10) as pages:
            assert pages.status == 200
        address = f"http://127.0.0.1:{port}/rrd/{ROAD_TOM}/run.rrd"
        with urllib.request.urlopen(address, timeout=10) as answer:
            assert answer.read() == (store / ROAD_TOM / "run.rrd").read_bytes()
            assert answer.headers["Access-Control-Allow-Origin"].startswith("http://127.0.0.1:")
        children = descendants(studio.pid)
        assert len(children) >= 3  # Streamlit, viser and the hub
        assert {address for address, _ in listening(children)} <= LOOPBACK
        ports = {port for _, port in listening(children)}
        assert {(str(port), str(port)) for port in ports} == set(tunnels)
        assert len(tunnels) == 3
    finally:
        studio.send_signal(signal.SIGTERM)
        assert studio.wait(30) == 0
    deadline = time.monotonic() + 10
    while any(map(alive, children)) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not [pid for pid in children if alive(pid)]
    assert is_free("127.0.0.1", port)


def test_a_store_that_is_not_there_yet_is_said_to_be_so(tmp_path: Path) -> None:
    assert in_words(tmp_path) == f"store {tmp_path}"
    assert in_words(tmp_path / "rnus") == f"store {tmp_path / 'rnus'}, which is not there yet"


@pytest.mark.slow
def test_two_studios_launched_at_once_each_serve_their_own_store(tmp_path: Path) -> None:
    both_up = Barrier(2, timeout=START_S)

    def served(name: str) -> str:
        (tmp_path / name).mkdir()
        with servers(Studio(store=tmp_path / name), Event()) as (links, running):
            assert running
            both_up.wait()
            with urllib.request.urlopen(f"{links.address}/api/health", timeout=10) as answer:
                store = json.load(answer)["store"]
            both_up.wait()
            return Path(store).name

    with ThreadPoolExecutor(2) as launches:
        assert list(launches.map(served, ["one", "other"])) == ["one", "other"]


@pytest.mark.slow
def test_a_port_held_for_a_moment_costs_the_studio_another_port_and_no_more(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    start, failures = launcher._start, []

    def passed_by(started: Sequence[Server], stopping: Event) -> Server | None:
        with socket.socket() as passer_by:
            if not failures:  # after the search for a free port, and gone when the servers fail
                passer_by.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                passer_by.bind(("127.0.0.1", started[-1].port))
                passer_by.listen()
            failures.append(start(started, stopping))
        return failures[-1]

    monkeypatch.setattr(launcher, "_start", passed_by)
    with servers(Studio(store=tmp_path), Event()) as (links, running):
        assert running
        with urllib.request.urlopen(f"{links.address}/api/health", timeout=10) as answer:
            assert json.load(answer)["store"] == str(tmp_path)
    first, *_, last = failures
    assert getattr(first, "name", None) == "streamlit"
    assert last is None


@pytest.mark.parametrize("at", range(3))
def test_each_server_says_that_its_port_was_taken_while_it_began(at: int, tmp_path: Path):
    links = launcher.plan(Studio(store=tmp_path), tmp_path)
    server = launcher.build(links, tmp_path)[at]
    with socket.socket() as passer_by:
        passer_by.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        passer_by.bind(("127.0.0.1", server.port))
        passer_by.listen()
        server.start()
        assert not server.wait_until_healthy(time.monotonic() + START_S, lambda: False)
        assert server.port_was_taken
    assert is_free("127.0.0.1", server.port)
    assert server.port_was_taken, "its log says so, too"


def test_a_server_that_cannot_start_is_launched_once_and_says_why(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    launches = tmp_path / "launches"
    broken = f"open({str(launches)!r}, 'a').write('x')\nraise RuntimeError('a broken viser')"
    (tmp_path / "viser.py").write_text(broken)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path), *sys.path]))
    with servers(Studio(store=tmp_path), Event()) as (_, running):
        assert running is None
    said = capsys.readouterr().err
    assert "viser did not start" in said
    assert "a broken viser" in said
    assert launches.read_text() == "x"


def test_a_port_that_is_taken_is_one_line_and_code_2(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        assert main(["--store", str(tmp_path), "--port", str(port), "--no-browser"]) == 2
    message = capsys.readouterr().err
    assert message.count("\n") == 1
    assert f"port {port} is taken" in message
    assert "--port" in message


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--port", "99999"], "--port 99999"),
        (["--port", "-1"], "--port -1"),
        (["--host", "203.0.113.7"], "--host 203.0.113.7"),
        (["--host", "no such host"], "--host no such host"),
        (["--host", "nosuch.invalid"], "--host nosuch.invalid"),
    ],
)
def test_bad_addresses_are_one_line_and_code_2(
    arguments: list[str], words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["--store", str(tmp_path), "--no-browser", *arguments]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert words in line


@pytest.mark.parametrize("option", ["--store", "--cinema", "--screenshots"])
def test_a_path_that_nobody_can_make_is_one_line_and_code_2(
    option: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["--store", str(tmp_path), "--no-browser", option, "a" * 300]) == 2
    assert capsys.readouterr().err.count("\n") == 1


@pytest.mark.parametrize("option", ["--cinema", "--screenshots"])
def test_a_file_where_pictures_are_to_go_is_said_before_any_is_made(
    option: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "there").write_text("mine")
    assert main(["--store", str(tmp_path), option, str(tmp_path / "there")]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "there is a file: name a folder" in line
    assert main(["--store", str(tmp_path), option, str(tmp_path / "there" / "film")]) == 2
    assert "there is a file: name a folder" in capsys.readouterr().err
    assert (tmp_path / "there").read_text() == "mine"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--run", "a"], "--run is that of --cinema"),
        (["--cinema", "film", "--screenshots", "pages"], "leave one out"),
    ],
)
def test_an_option_that_would_do_nothing_is_refused(
    words: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["--store", str(tmp_path), *words]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert said in line


def test_without_a_browser_no_part_of_a_film_is_left(
    store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    words = ["--store", str(store), "--run", PENDULUM_TOM, "--cinema", str(tmp_path / "film")]
    assert main(words) == 2
    assert "this needs Chromium" in capsys.readouterr().err
    assert not (tmp_path / "film").exists()


def test_a_store_that_is_a_file_is_one_line_and_code_2(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "runs").write_text("")
    assert main(["--store", str(tmp_path / "runs"), "--no-browser"]) == 2
    assert capsys.readouterr().err.count("\n") == 1


@pytest.mark.parametrize("arguments", [["--prot", "1"], ["--theme", "pink"], ["--port", "x"]])
def test_unknown_arguments_are_code_2(
    arguments: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as stopped:
        main(arguments)
    assert stopped.value.code == 2
    assert capsys.readouterr().err.count("\n") == 1
