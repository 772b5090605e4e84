"""Work that is killed while it puts one file or folder in the place of another."""

import os
import signal
import sys
from collections.abc import Callable


def killed_at_rename(number: int, work: Callable[[], object]) -> bool:
    """Do `work` in a process of its own, which the n-th rename kills; whether it came so far."""
    if child := os.fork():
        return os.waitpid(child, 0)[1] == signal.SIGKILL
    renames: list[object] = []

    def watch(event: str, args: tuple[object, ...]) -> None:
        if event == "os.rename":
            renames.append(args)
            if len(renames) == number:
                os.kill(os.getpid(), signal.SIGKILL)

    sys.addaudithook(watch)
    try:
        work()
    finally:
        os._exit(0)
