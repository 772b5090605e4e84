"""Opens the Ray engine. The variables that Ray reads must be set before its import."""

import os
import secrets
import socket
from importlib.util import find_spec

from tom.errors import UserError
from tom.sweep.engine import Engine

ANSWER_S = 5.0  # a cluster's head answers within this


def open_ray(address: str | None, jobs: int | None) -> Engine:
    """The engine for the Ray cluster at `address`, or for one here that ends with the sweep.

    It runs `jobs` trainings at a time (default: one per core of the cluster). Every client of the
    cluster needs its token, because Ray listens on all interfaces and runs what it receives. Raises
    UserError if Ray is not installed or the cluster cannot be joined.
    """
    if find_spec("ray") is None:
        raise UserError('--engine ray needs Ray: pip install -e ".[cluster]"')
    os.environ.setdefault("RAY_AUTH_MODE", "token")
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    if address is None:
        os.environ["RAY_AUTH_TOKEN"] = secrets.token_hex(32)
    else:
        _reach(address)
    from tom.sweep.ray_engine import RayEngine

    return RayEngine(address, jobs)


def _reach(address: str) -> None:
    """Raises UserError if nothing listens at HOST:PORT, because Ray would try for minutes."""
    host, _, port = address.rpartition(":")
    if not host or not port.isdecimal():
        raise UserError(f"--address {address}: must be HOST:PORT, as `ray start --head` prints it")
    try:
        socket.create_connection((host.strip("[]"), int(port)), ANSWER_S).close()
    except (OSError, OverflowError) as error:
        raise UserError(f"--address {address}: no Ray cluster answers there ({error})") from None
