"""The Rerun hub of a studio: one process that a launcher starts, watches and ends.

`python -m tom.record.rerun.hub` serves Rerun's web viewer and growing recordings: of all running
trainings in the store, and of any single run. Everything goes over one port, which checks each
request. It listens on 127.0.0.1 unless told otherwise, and ends with its parent.

Rerun's own server answers every page and program that reaches its ports, and has no option against
this. So it runs only until the viewer's files have been copied from it.
"""

import argparse
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from urllib.parse import quote

import rerun_cli

from tom import plugins
from tom.machine import processes
from tom.machine.address import free_port
from tom.record.rerun import web

START_S = 30.0
STOP_S = 3.0


def command(host: str, port: int, store: Path | str, studio_port: int = 0) -> list[str]:
    """The command that runs the hub of `store`; it is ready when GET / on `port` returns 200.

    The pages on `studio_port` may embed the viewer.
    """
    options = {"--host": host, "--port": port, "--store": store, "--studio-port": studio_port}
    given = [str(part) for option in options.items() for part in option]
    return [sys.executable, "-m", "tom.record.rerun.hub", *given]


def binary() -> Path:
    """The path of Rerun's program, because killing the wheel's Python wrapper would orphan it."""
    return Path(rerun_cli.__file__).with_name("rerun")


def viewer_url(host: str, port: int, source: str, theme: str = "dark") -> str:
    """The web viewer's address showing `source`: a `live_url` or a file's URL."""
    query = f"url={quote(source, safe='')}&hide_welcome_screen&persist=false&notebook=false"
    return f"http://{host}:{port}/?{query}&theme={theme}"


def live_url(host: str, port: int, run_id: str = "") -> str:
    """The URL of a growing recording of one run of the store, or of all running ones."""
    return f"http://{host}:{port}/live{f'/{quote(run_id)}' if run_id else ''}.rrd"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the hub until SIGTERM or SIGINT; returns 0, or 1 if Rerun does not start."""
    parser = argparse.ArgumentParser(prog="tom.record.rerun.hub", description=__doc__)
    parser.add_argument("--host", default="127.0.0.1")
    parser.add_argument("--port", type=int, required=True)
    parser.add_argument("--store", type=Path, default=Path("runs"))
    parser.add_argument("--studio-port", type=int, default=0)
    args = parser.parse_args(arguments)
    plugins.load()
    stopping = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stopping.set())
    live = partial(_live, args.store, stopping)
    try:
        page = web.ViewerServer(args.host, args.port, viewer_files(), live, args.studio_port)
    except TimeoutError as error:
        print(f"the Rerun viewer is not there: {error}", file=sys.stderr)
        return 1
    page.start()
    stopping.wait()
    page.shutdown()
    return 0


def viewer_files() -> dict[str, web.Asset]:
    """The web viewer's files by path, from Rerun's own server.

    Raises TimeoutError if that does not answer.
    """
    with tempfile.TemporaryDirectory(prefix="tom-hub-") as folder:
        port = free_port("127.0.0.1")
        rerun = _start(port, without_analytics(Path(folder)))
        try:
            return _taken(rerun, port)
        finally:
            processes.stop([rerun], STOP_S)


def _taken(rerun: processes.Process, port: int) -> dict[str, web.Asset]:
    deadline = time.monotonic() + START_S
    while True:
        try:
            return web.assets(("127.0.0.1", port))
        except OSError as error:
            if rerun.poll() is not None or time.monotonic() > deadline:
                raise TimeoutError(error) from error
            time.sleep(0.05)


def _live(store: Path, stopping: threading.Event, run_id: str) -> Iterator[bytes]:
    # Imported here because the viewer's page does not need it.
    from tom.record.rerun.feed import stream, stream_all
    from tom.record.store import Store

    if run_id:
        return stream(Store(store).run(run_id), stopping)
    return stream_all(Store(store), stopping)


def _start(port: int, environment: Mapping[str, str]) -> processes.Process:
    host = "127.0.0.1"
    options = ["--serve-web", "--bind", host, "--port", str(free_port(host))]
    command = [str(binary()), *options, "--web-viewer-port", str(port)]
    # In the hub's process group, which the studio ends as a whole, and with the hub's log, which
    # then says why Rerun does not start.
    return processes.start(command, None, environment, session=False)


def without_analytics(folder: Path) -> dict[str, str]:
    """Environment variables that turn off Rerun's usage statistics; user settings stay."""
    settings = {"XDG_CONFIG_HOME": str(folder), "XDG_DATA_HOME": str(folder)}
    environment = {**os.environ, **settings}
    command = [str(binary()), "analytics", "disable"]
    subprocess.run(command, env=environment, check=True, capture_output=True)
    return environment


if __name__ == "__main__":
    # Open streams and torch would delay the exit by seconds.
    code = main()
    sys.stdout.flush()
    os._exit(code)
