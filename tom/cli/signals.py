"""The signals that ask a command which trains to stop."""

import signal
from collections.abc import Callable
from types import FrameType

STOPPING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def on_stopping(stop: Callable[[int, FrameType | None], object]) -> None:
    """Call `stop` on Ctrl-C (also where a shell put us in the background), SIGTERM and SIGHUP.

    A closed terminal sends SIGHUP; what was begun under nohup goes on without one.
    """
    for number in STOPPING:
        under_nohup = number is signal.SIGHUP and signal.getsignal(number) is signal.SIG_IGN
        if not under_nohup:
            signal.signal(number, stop)
