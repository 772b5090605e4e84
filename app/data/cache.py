"""A cache of results that change with a version, such as the time stamp of a file."""

from collections import OrderedDict
from collections.abc import Callable, Hashable
from threading import Lock
from typing import Generic, TypeVar

T = TypeVar("T")


class VersionedCache(Generic[T]):
    """The `most` results used last, one for each key. Safe for threads.

    A key holds one version: a new one (its file has changed) replaces the old.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._results: OrderedDict[Hashable, tuple[Hashable, T]] = OrderedDict()
        self._lock = Lock()

    def get(self, key: Hashable, make: Callable[[], T], version: Hashable = None) -> T:
        """The result for `key`, made where it is not kept in this `version`.

        It is shared: nobody may change it.
        """
        with self._lock:
            found = self._results.get(key)
            if found is not None and found[0] == version:
                self._results.move_to_end(key)
                return found[1]
        made = make()
        with self._lock:
            self._results[key] = version, made
            self._results.move_to_end(key)
            while len(self._results) > self._most:
                self._results.popitem(last=False)
        return made
