"""Arrays that a browser fetches in binary, once: named by what they are made of.

A page offers an array; only when a browser has not kept it, it is made and sent.
"""

import hashlib
from collections.abc import Callable
from threading import Lock

from cachetools import LRUCache
from numpy.typing import NDArray

PATH = "api/arrays"
OFFERED = 20_000
"""arrays that are known at a time; each page offers its own again when it is drawn"""

_MAKERS: LRUCache[str, Callable[[], NDArray]] = LRUCache(OFFERED)
_LOCK = Lock()


def offer(key: tuple[object, ...], make: Callable[[], NDArray]) -> str:
    """The address of the array of `key`, which holds its version; `make` should hold no array."""
    name = hashlib.sha256(repr(key).encode()).hexdigest()[:32]
    with _LOCK:
        _MAKERS[name] = make
    return f"{PATH}/{name}"


def content(name: str) -> bytes | None:
    """The bytes of an offered array, little-endian; None if no page has offered it."""
    with _LOCK:
        make = _MAKERS.get(name)
    return None if make is None else make().tobytes()
