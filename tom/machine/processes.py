"""Child processes, which end with their parent unless they are meant to outlive it, and signals."""

import ctypes
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from types import FrameType
from typing import IO

Process = subprocess.Popen[bytes]
Handler = Callable[[int, FrameType | None], object]

STOPPING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_PR_SET_PDEATHSIG = 1


def start(
    command: Sequence[str],
    out: IO[bytes] | int | None,
    environment: Mapping[str, str] | None = None,
    *,
    session: bool = True,
    outlives: bool = False,
) -> Process:
    """Start `command` with empty stdin and stdout to `out` (None: this process's stdout).

    With `session` it gets its own session and process group, so that Ctrl-C in this terminal does
    not reach it unless its parent passes it on. It ends with the thread that called this, also
    after kill -9 (Linux: the kernel sends SIGTERM), unless `outlives` is set. Raises OSError if it
    cannot start.
    """
    bound = not outlives and sys.platform == "linux"
    return subprocess.Popen(
        command,
        env=environment,
        stdin=subprocess.DEVNULL,
        stdout=out,
        stderr=out,
        start_new_session=session,
        preexec_fn=end_with_parent if bound else None,
    )


def start_module(arguments: Sequence[str], out: IO[bytes] | int | None) -> Process:
    """Start `python -m` followed by `arguments`, with one thread for torch and BLAS."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    return start([sys.executable, "-m", *arguments], out, environment)


def stop(processes: Sequence[Process], grace_s: float) -> None:
    """Ask all processes to stop; kill each that has not stopped after `grace_s` seconds."""
    for process in processes:
        process.terminate()
    for process in processes:
        with suppress(subprocess.TimeoutExpired):
            process.wait(grace_s)
            continue
        process.kill()
        process.wait()


def end_with_parent() -> None:
    """Let the kernel send this process SIGTERM when its parent dies, also by kill -9 (Linux).

    The parent is the thread that started it.
    """
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)


@contextmanager
def on_stopping(stop: Handler, numbers: Sequence[signal.Signals] = STOPPING) -> Iterator[None]:
    """Inside the block, call `stop` on Ctrl-C (also if a shell started us in the background),
    SIGTERM and SIGHUP; afterwards their handlers are what they were.

    `stop` is called for the first signal and then only for Ctrl-C, since only a person asks twice
    on purpose: a closed terminal often sends SIGHUP twice, and whoever ends a session or job sends
    SIGTERM to a sweep and to its trainings, which the sweep also asks. A command started with nohup
    ignores SIGHUP.
    """
    received: list[int] = []

    def handler(number: int, frame: FrameType | None) -> None:
        received.append(number)
        if len(received) == 1 or number == signal.SIGINT:
            stop(number, frame)

    before = {number: signal.getsignal(number) for number in numbers}
    try:
        for number, previous in before.items():
            under_nohup = number is signal.SIGHUP and previous is signal.SIG_IGN
            if not under_nohup:
                signal.signal(number, handler)
        yield
    finally:
        for number, previous in before.items():
            if previous is not None:  # None: it was not Python's
                signal.signal(number, previous)
