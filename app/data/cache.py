"""Results that are shared by all visitors and made anew when their version changes.

The version is usually the time stamp of a file. All results share one budget of bytes; those that
were used least recently are dropped first.
"""

import sys
from collections.abc import Callable, Hashable, Iterable, Mapping
from itertools import count
from threading import RLock
from typing import Any, Generic, Protocol, TypeVar, runtime_checkable

import pandas as pd
from cachetools import LRUCache

from tom.machine.memory import STUDIO_CACHE_BYTES

T = TypeVar("T")

RESULTS: LRUCache[tuple[int, Hashable], tuple[Hashable, Any]] = LRUCache(
    # A result that is larger than the budget is kept alone.
    STUDIO_CACHE_BYTES,
    lambda held: min(bytes_of(held[1]), STUDIO_CACHE_BYTES),
)
LOCK = RLock()
_NUMBERS = count()


class VersionedCache(Generic[T]):
    """One result a key: a new version replaces the old one. Thread-safe."""

    def __init__(self) -> None:
        self._number = next(_NUMBERS)

    def get(self, key: Hashable, make: Callable[[], T], version: Hashable = None) -> T:
        """The result for `key`, made if it is not cached in this `version`.

        It is shared and must not be changed.
        """
        place = self._number, key
        with LOCK:
            held = RESULTS.get(place)
        if held is not None and held[0] == version:
            return held[1]
        made = make()
        with LOCK:
            RESULTS[place] = version, made
        return made


@runtime_checkable
class Weighted(Protocol):
    """A `torch.nn.Module`; importing torch takes seconds."""

    def parameters(self) -> Iterable[Any]: ...
    def buffers(self) -> Iterable[Any]: ...


def bytes_of(value: object) -> int:
    """The approximate bytes of arrays, tables and tensors in `value`, at any depth."""
    size, seen, waiting = 0, set[int](), [value]
    while waiting:
        one = waiting.pop()
        if id(one) in seen:
            continue
        seen.add(id(one))
        size += _own_bytes(one)
        waiting.extend(_parts(one))
    return size


def _own_bytes(one: object) -> int:
    if isinstance(one, pd.DataFrame):
        return 8 * one.size  # of numbers; asking every column would take longer than reading some
    size = getattr(one, "nbytes", None)  # arrays and tensors
    return size if isinstance(size, int) else sys.getsizeof(one, 0)


def _parts(one: object) -> list[Any]:
    if isinstance(one, Weighted):
        return [*one.parameters(), *one.buffers()]
    if isinstance(one, Mapping):
        return [*one.keys(), *one.values()]
    if isinstance(one, list | tuple | set | frozenset):
        return [*one]
    ours = type(one).__module__.partition(".")[0] in ("tom", "app")
    return [*vars(one).values()] if ours and hasattr(one, "__dict__") else []
