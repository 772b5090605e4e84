"""A head that is there, is away for a while, and is gone."""

import socket
from itertools import chain, repeat

import pytest

from tom.sweep.engine import GoneError
from tom.sweep.ray_head import GONE_S, Head


def test_a_head_that_is_silent_for_long_is_gone():
    listening = socket.create_server(("127.0.0.1", 0))
    address = f"127.0.0.1:{listening.getsockname()[1]}"
    times = chain([0.0, 100.0, 101.0], repeat(100.0 + GONE_S))
    head = Head(address, clock=lambda: next(times))
    assert head.answers()
    listening.close()
    assert not head.answers()
    with pytest.raises(GoneError, match=r"has not answered for 20 s: .* stop with a checkpoint"):
        head.answers()
    with socket.create_server(("127.0.0.1", int(address.rpartition(":")[2]))):
        assert head.answers()
