"""A cache of results that change with a version, such as the time stamp of a file.

All caches of a server share one budget of bytes (`ROOM`): the least recently used result is dropped
first, whichever cache it is in.
"""

import sys
from collections import OrderedDict
from collections.abc import Callable, Hashable, Mapping
from threading import RLock
from typing import Any, Generic, TypeVar
from weakref import ref

import numpy as np
import pandas as pd
import torch

from tom.machine.memory import STUDIO_CACHE_BYTES

T = TypeVar("T")


class Room:
    """A budget of `most` bytes for results; a single larger one is allowed. Thread-safe."""

    def __init__(self, most: int) -> None:
        self.most = most
        self.bytes = 0
        self.lock = RLock()
        # Weak references: results of a deleted cache are free already and are dropped in turn.
        self._held: OrderedDict[tuple[int, Hashable], tuple[ref[VersionedCache[Any]], int]] = (
            OrderedDict()
        )

    def enter(self, cache: "VersionedCache[Any]", key: Hashable, size: int) -> None:
        """Add `size` bytes of `cache` under `key`; drop other results if the budget is exceeded."""
        self.leave(cache, key)
        self._held[id(cache), key] = ref(cache), size
        self.bytes += size
        while self.bytes > self.most and len(self._held) > 1:
            (_, oldest), (owner, freed) = self._held.popitem(last=False)
            self.bytes -= freed
            if (of := owner()) is not None:
                of.forget(oldest)

    def used(self, cache: "VersionedCache[Any]", key: Hashable) -> None:
        """Mark the result as used just now."""
        self._held.move_to_end((id(cache), key))

    def leave(self, cache: "VersionedCache[Any]", key: Hashable) -> None:
        """Remove a result that `cache` no longer holds."""
        _, freed = self._held.pop((id(cache), key), (None, 0))
        self.bytes -= freed


ROOM = Room(STUDIO_CACHE_BYTES)


class VersionedCache(Generic[T]):
    """The `most` results used last, one per key, within the budget `room`. Thread-safe.

    A key holds one version: a new one (after its file has changed) replaces the old.
    """

    def __init__(self, most: int, room: Room = ROOM) -> None:
        self._most = most
        self._room = room
        self._results: OrderedDict[Hashable, tuple[Hashable, T]] = OrderedDict()

    def get(self, key: Hashable, make: Callable[[], T], version: Hashable = None) -> T:
        """The result for `key`, made if it is not cached in this `version`.

        It is shared and must not be changed.
        """
        with self._room.lock:
            held = self._results.get(key)
            if held is not None and held[0] == version:
                self._results.move_to_end(key)
                self._room.used(self, key)
                return held[1]
        made = make()
        size = bytes_of(made)
        with self._room.lock:
            self._results[key] = version, made
            self._results.move_to_end(key)
            self._room.enter(self, key, size)
            while len(self._results) > self._most:
                self.forget(next(iter(self._results)))
        return made

    def forget(self, key: Hashable) -> None:
        """Drop the result for `key`."""
        with self._room.lock:
            self._results.pop(key, None)
            self._room.leave(self, key)


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
    if isinstance(one, np.ndarray):
        return one.nbytes
    if isinstance(one, torch.Tensor):
        return one.numel() * one.element_size()
    if isinstance(one, pd.DataFrame):
        return int(one.memory_usage(deep=True).sum())
    return sys.getsizeof(one, 0)


def _parts(one: object) -> list[Any]:
    if isinstance(one, torch.nn.Module):
        return [*one.parameters(), *one.buffers()]
    if isinstance(one, Mapping):
        return [*one.keys(), *one.values()]
    if isinstance(one, list | tuple | set | frozenset):
        return [*one]
    ours = type(one).__module__.partition(".")[0] in ("tom", "app")
    caches = isinstance(one, VersionedCache)  # its results are counted separately
    return [*vars(one).values()] if ours and not caches and hasattr(one, "__dict__") else []
