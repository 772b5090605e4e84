"""Real servers for the fault tests: a studio, a Rerun hub, and what the kernel says of them."""

import re
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from http.client import HTTPConnection
from pathlib import Path

from faults import wait_until

from tom.record.rerun import hub


@contextmanager
def studio(store: Path, *arguments: object) -> Iterator[tuple[subprocess.Popen[str], int]]:
    """A studio of `store`, and the port of its pages; ended with SIGTERM where it still runs."""
    command = [sys.executable, "-m", "app", "--store", store, "--no-browser", *arguments]
    process = subprocess.Popen(
        [str(part) for part in command],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    try:
        assert process.stdout is not None
        line = ""
        while not (found := re.search(r"http://[^ :]+:(\d+)", line)):
            line = process.stdout.readline()
            assert line, "the studio ended before it was up"
        yield process, int(found[1])
    finally:
        if process.poll() is None:
            process.send_signal(signal.SIGTERM)
            process.wait(60)


@contextmanager
def live_hub(store: Path) -> Iterator[tuple[subprocess.Popen[bytes], int]]:
    """A hub as the studio runs it: the process and its port."""
    port = hub.free_port("127.0.0.1")
    process = subprocess.Popen(hub.command("127.0.0.1", port, store), stderr=subprocess.DEVNULL)
    try:
        wait_until(lambda: answers(port))
        yield process, port
    finally:
        process.terminate()
        try:
            process.wait(10)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def answers(port: int, path: str = "/") -> bool:
    """The server on `port` says 200."""
    connection = HTTPConnection("127.0.0.1", port, timeout=5)
    try:
        connection.request("GET", path)
        return connection.getresponse().status == 200
    except OSError:
        return False
    finally:
        connection.close()


def is_taken(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


def command_of(pid: int) -> str:
    return Path(f"/proc/{pid}/cmdline").read_bytes().replace(b"\0", b" ").decode()
