"""Whether the head of a Ray cluster still answers. Ray itself would end a driver without one."""

import socket
import time
from collections.abc import Callable

from tom.sweep.engine import GoneError

CONNECT_S, GONE_S = 2.0, 20.0  # Ray takes 60 s, and then ends the process with a message of its own


class Head:
    """The main process of a Ray cluster, at HOST:PORT."""

    def __init__(self, address: str, clock: Callable[[], float] = time.monotonic) -> None:
        """`clock` returns seconds that never decrease."""
        host, _, port = address.rpartition(":")
        self._address = (host.strip("[]"), int(port))
        self._clock = clock
        self._heard = clock()

    def answers(self) -> bool:
        """Whether it answers. Raises GoneError if it has not answered for GONE_S."""
        try:
            socket.create_connection(self._address, CONNECT_S).close()
        except OSError as error:
            silent_s = self._clock() - self._heard
            if silent_s < GONE_S:
                return False
            raise GoneError(
                f"the head of the Ray cluster has not answered for {silent_s:.0f} s: trainings on "
                "its machines stop with a checkpoint once they notice"
            ) from error
        self._heard = self._clock()
        return True
