"""Real servers for the fault tests: a studio, and what the kernel says of it."""

import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from http.client import HTTPConnection
from pathlib import Path


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


def command_of(pid: int) -> str:
    return Path(f"/proc/{pid}/cmdline").read_bytes().replace(b"\0", b" ").decode()
