"""The Rerun hub of a studio: one process that a launcher starts, watches and ends.

`python -m tom.record.rerun.hub` runs Rerun's own hub (viewers and SDKs connect to `port`), serves
the web viewer's page and every run's growing recording (`web_port`), and feeds the store's running
runs to the hub. It listens on 127.0.0.1 unless told otherwise, and ends with its parent.
"""

import argparse
import os
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from urllib.parse import quote

import rerun_cli

from tom.machine.address import free_port, local_host
from tom.machine.parent import end_with_parent
from tom.record.rerun import web

MEMORY = "512MiB"
"""What the hub keeps for viewers that come late; then the oldest goes."""

STOP_S = 3.0


def command(host: str, port: int, web_port: int, store: Path | str) -> list[str]:
    """The command that runs the hub of `store`; it is up when GET / on `web_port` says 200."""
    options = {"--host": host, "--port": port, "--web-port": web_port, "--store": store}
    given = [str(part) for option in options.items() for part in option]
    return [sys.executable, "-m", "tom.record.rerun.hub", *given]


def binary() -> Path:
    """Rerun's own program: killing the Python wrapper in the wheel would orphan it."""
    return Path(rerun_cli.__file__).with_name("rerun")


def viewer_url(host: str, web_port: int, source: str, theme: str = "dark") -> str:
    """The web viewer's address showing `source`: a `live_url`, a `hub_url` or a file's URL."""
    query = f"url={quote(source, safe='')}&hide_welcome_screen&persist=false&notebook=false"
    return f"http://{host}:{web_port}/?{query}&theme={theme}"


def hub_url(host: str, port: int) -> str:
    """Where viewers and SDKs reach a hub."""
    return f"rerun+http://{host}:{port}/proxy"


def live_url(host: str, web_port: int, run_id: str) -> str:
    """The recording of one run of the store, made on the spot; it grows while the run trains."""
    return f"http://{host}:{web_port}/live/{quote(run_id)}.rrd"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the hub until SIGTERM or SIGINT (0), or until Rerun's process ends (1)."""
    parser = argparse.ArgumentParser(prog="tom.record.rerun.hub", description=__doc__)
    parser.add_argument("--host", default="127.0.0.1")
    parser.add_argument("--port", type=int, required=True)
    parser.add_argument("--web-port", type=int, required=True)
    parser.add_argument("--store", type=Path, default=Path("runs"))
    args = parser.parse_args(arguments)
    stopping = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stopping.set())
    with tempfile.TemporaryDirectory(prefix="tom-hub-") as folder:
        return _serve(args, Path(folder), stopping)


def _serve(args: argparse.Namespace, folder: Path, stopping: threading.Event) -> int:
    host, inner = local_host(args.host), free_port(args.host)
    rerun = _start(args.host, args.port, inner, args.web_port, without_analytics(folder))
    try:
        page = web.Server(
            args.host, args.web_port, (host, inner), partial(_live, args.store, stopping)
        )
        page.start()
        feeder = threading.Thread(
            target=_feed, args=(args.store, host, args.port, stopping), name="feed", daemon=True
        )
        feeder.start()
        while not stopping.wait(0.5):
            if rerun.poll() is not None:
                print(f"the Rerun hub ended with code {rerun.returncode}", file=sys.stderr)
                return 1
        page.shutdown()
        return 0
    finally:
        stopping.set()
        _stop(rerun)


def _feed(store: Path, host: str, port: int, stopping: threading.Event) -> None:
    # Imported here: the viewer's page need not wait for it.
    from tom.record.rerun.feed import Feeder
    from tom.record.store import Store

    Feeder(Store(store), host, port).run(stopping)


def _live(store: Path, stopping: threading.Event, run_id: str) -> Iterator[bytes]:
    from tom.record.rerun.feed import stream
    from tom.record.store import Store

    return stream(Store(store).run(run_id), stopping)


def _start(
    host: str, port: int, inner: int, web_port: int, environment: Mapping[str, str]
) -> subprocess.Popen[bytes]:
    options = ["--serve-web", "--bind", host, "--port", str(port)]
    options += ["--web-viewer-port", str(inner), "--server-memory-limit", MEMORY]
    if host not in ("127.0.0.1", "localhost"):
        options += ["--cors-allow-origin", f"http://*:{web_port}"]
    return subprocess.Popen(
        [str(binary()), *options],
        env=environment,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        preexec_fn=end_with_parent if sys.platform == "linux" else None,
    )


def without_analytics(folder: Path) -> dict[str, str]:
    """The environment in which Rerun sends no usage statistics; the user's own is untouched."""
    settings = {"XDG_CONFIG_HOME": str(folder), "XDG_DATA_HOME": str(folder)}
    environment = {**os.environ, **settings}
    command = [str(binary()), "analytics", "disable"]
    subprocess.run(command, env=environment, check=True, capture_output=True)
    return environment


def _stop(process: subprocess.Popen[bytes]) -> None:
    process.terminate()
    try:
        process.wait(STOP_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


if __name__ == "__main__":
    # Rerun holds what a dead hub did not take and would wait for it at exit.
    code = main()
    sys.stdout.flush()
    os._exit(code)
