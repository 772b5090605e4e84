"""The signals that ask a training command to stop."""

import signal
from collections.abc import Callable
from types import FrameType

STOPPING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def on_stopping(stop: Callable[[int, FrameType | None], object]) -> None:
    """Call `stop` on Ctrl-C (also if a shell started us in the background), SIGTERM and SIGHUP.

    A closed terminal sends SIGHUP; a command started with nohup ignores it.
    """
    for number in STOPPING:
        under_nohup = number is signal.SIGHUP and signal.getsignal(number) is signal.SIG_IGN
        if not under_nohup:
            signal.signal(number, stop)
