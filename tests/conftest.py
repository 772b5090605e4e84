"""One thread for each worker: small networks gain nothing from two, and workers share the cores."""

import ctypes
import os
import sys
from collections.abc import Iterator
from urllib.request import Request, urlopen

import pytest

CAPABILITIES = 0x20080522
"""the version of the kernel's interface to the capabilities of a thread"""
OVERRIDE = 1 << 1 | 1 << 2
"""those by which root reads what its mode forbids"""

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before torch is imported; children inherit it


@pytest.fixture(autouse=True)
def main_stays_main() -> Iterator[None]:
    """Streamlit makes a page that is drawn here the main module, which child processes import."""
    before = sys.modules["__main__"]
    yield
    sys.modules["__main__"] = before


@pytest.fixture
def modes_count() -> Iterator[None]:
    """The modes of files are for this thread, and those that it starts, what they are for users."""
    kernel = ctypes.CDLL(None, use_errno=True)
    header, held = (ctypes.c_uint32 * 2)(CAPABILITIES, 0), (ctypes.c_uint32 * 6)()
    assert kernel.capget(header, held) == 0
    effective = held[0]
    held[0] = effective & ~OVERRIDE
    assert kernel.capset(header, held) == 0
    yield
    held[0] = effective
    assert kernel.capset(header, held) == 0


@pytest.fixture
def bucket_url(monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """An empty place in an object store of this machine; the environment says how to get there."""
    from moto.server import ThreadedMotoServer  # here: it takes a second

    server = ThreadedMotoServer("127.0.0.1", port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    endpoint = f"http://{host}:{port}"
    monkeypatch.delenv("AWS_ENDPOINT_URL_S3", raising=False)
    monkeypatch.setenv("AWS_ENDPOINT_URL", endpoint)
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", "nobody")
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "nothing")
    monkeypatch.setenv("AWS_DEFAULT_REGION", "us-east-1")
    for path, method in (("moto-api/reset", "POST"), ("store", "PUT")):
        urlopen(Request(f"{endpoint}/{path}", method=method)).close()
    yield "s3://store/sweeps/first"
    server.stop()
