"""The launcher: one address, errors in one line, and an end without orphans."""

import os
import re
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from contextlib import suppress
from pathlib import Path
from threading import Event

import pytest
from commands import code_of
from kernel import LOOPBACK, alive, descendants, listening, wait_for
from studio_runs import PENDULUM_TOM, ROAD_TOM

from app.__main__ import main
from app.links import Links
from app.servers.launcher import is_free, serving
from tom.machine.address import free_port

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
        [tunnel] = re.findall(r"-L (\d+):127\.0\.0\.1:(\d+)", studio.stdout.readline())
        assert f"http://127.0.0.1:{port}" in line, line
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/api/health", timeout=10) as answer:
            assert str(store) in answer.read().decode()
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/_stcore/health", timeout=10) as pages:
            assert pages.status == 200
        address = f"http://127.0.0.1:{port}/rrd/{ROAD_TOM}/run.rrd"
        with urllib.request.urlopen(address, timeout=10) as answer:
            assert answer.read() == (store / ROAD_TOM / "run.rrd").read_bytes()
        os.kill(first := scenes_of(studio.pid), signal.SIGKILL)
        scenes_of(studio.pid, after=first)
        children = descendants(studio.pid)
        assert len(children) == 2
        (address, own), *others = listening(children)
        assert address in LOOPBACK
        assert (str(own), str(own)) == tunnel
        assert not others
    finally:
        studio.send_signal(signal.SIGTERM)
        assert studio.wait(30) == 0
    wait_for(lambda: not any(map(alive, children)), 10)
    assert is_free("127.0.0.1", port)


def scenes_of(pid: int, after: int = 0) -> int:
    """The 3D server of a studio, once its page server has started one, again after another."""
    deadline = time.monotonic() + START_S
    while time.monotonic() < deadline:
        for child in descendants(pid) - {after}:
            with suppress(OSError):
                if b"app.scenes.server" in Path(f"/proc/{child}/cmdline").read_bytes():
                    return child
        time.sleep(0.05)
    pytest.fail("there is no 3D server")


def test_a_server_that_cannot_start_is_launched_once_and_says_why(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    launches = tmp_path / "launches"
    broken = f"open({str(launches)!r}, 'a').write('x')\nraise RuntimeError('a broken plotly')"
    (tmp_path / "plotly.py").write_text(broken)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path), *sys.path]))
    with serving(Links(str(tmp_path)), Event()) as (_, running):
        assert running is None
    assert "a broken plotly" in capsys.readouterr().err
    assert launches.read_text() == "x"


@pytest.mark.parametrize(
    "arguments",
    [
        ["--port", "99999"],
        ["--port", "{taken}"],
        ["--host", "203.0.113.7"],
        ["--host", "no such host"],
        ["--store", "a" * 300],
        ["--cinema", "a" * 300],
        ["--store", "{file}"],
        ["--theme", "pink"],
        ["--base-path", "x"],
    ],
)
def test_what_cannot_be_is_one_line_that_names_it_and_code_2(
    arguments: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("")
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        values = {"taken": taken.getsockname()[1], "file": tmp_path / "file"}
        given = [part.format(**values) for part in arguments]
        assert code_of(["--store", str(tmp_path), "--no-browser", *given], main) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert given[1] in line


@pytest.mark.parametrize("place", ["there", "there/film"])
def test_a_file_where_pictures_are_to_go_is_refused(place: str, tmp_path: Path) -> None:
    (tmp_path / "there").write_text("mine")
    assert main(["--store", str(tmp_path), "--cinema", str(tmp_path / place)]) == 2
    assert (tmp_path / "there").read_text() == "mine"


@pytest.mark.parametrize("words", [["--run", "a"], ["--cinema", "film", "--screenshots", "pages"]])
def test_an_option_that_would_do_nothing_is_refused(words: list[str], tmp_path: Path) -> None:
    assert main(["--store", str(tmp_path), *words]) == 2


def test_without_a_browser_no_part_of_a_film_is_left(
    store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    words = ["--store", str(store), "--run", PENDULUM_TOM, "--cinema", str(tmp_path / "film")]
    assert main(words) == 2
    assert not (tmp_path / "film").exists()
