"""The signals that ask a command to stop."""

import signal
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from types import FrameType

STOPPING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)

Handler = Callable[[int, FrameType | None], object]


@contextmanager
def on_stopping(stop: Handler, numbers: Sequence[signal.Signals] = STOPPING) -> Iterator[None]:
    """Inside the block, call `stop` on Ctrl-C (also if a shell started us in the background),
    SIGTERM and SIGHUP; afterwards their handlers are what they were.

    A closed terminal sends SIGHUP; a command started with nohup ignores it.
    """
    before = {number: signal.getsignal(number) for number in numbers}
    handler = _requests(stop)
    try:
        for number, held in before.items():
            under_nohup = number is signal.SIGHUP and held is signal.SIG_IGN
            if not under_nohup:
                signal.signal(number, handler)
        yield
    finally:
        for number, held in before.items():
            if held is not None:  # None: it was not Python's
                signal.signal(number, held)


def _requests(stop: Handler) -> Handler:
    """`stop`, called for the first signal of any kind and then for Ctrl-C alone.

    Only a person asks twice on purpose. A terminal that closes often sends SIGHUP twice, from its
    shell and from the kernel, and whoever ends a whole session or job sends SIGTERM to a sweep and
    to its trainings, which the sweep asks as well.
    """
    heard: list[int] = []

    def handler(number: int, frame: FrameType | None) -> None:
        heard.append(number)
        if len(heard) == 1 or number == signal.SIGINT:
            stop(number, frame)

    return handler
