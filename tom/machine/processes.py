"""Child processes: they end with their parent, unless they are meant to outlive it."""

import ctypes
import os
import signal
import subprocess
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import IO

Process = subprocess.Popen[bytes]

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


def single_threaded(**more: str) -> dict[str, str]:
    """This process's environment variables, with one thread for torch and BLAS, and `more`."""
    return {**os.environ, "OMP_NUM_THREADS": "1", **more}


def end_with_parent() -> None:
    """Let the kernel send this process SIGTERM when its parent dies, also by kill -9 (Linux).

    The parent is the thread that started it.
    """
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
