"""Results that are shared by all visitors and made anew when their version changes.

All results share one budget of bytes; those that were used least recently are dropped first.

At the end are arrays that a browser fetches in binary, once: named by what they are made of. A page
offers one; only when a browser has not kept it, it is made and sent.
"""

import hashlib
import sys
from collections.abc import Callable, Hashable, Mapping
from functools import wraps
from threading import RLock
from typing import Any, ParamSpec, TypeVar
from weakref import WeakValueDictionary

import pandas as pd
from cachetools import LRUCache
from numpy.typing import NDArray

from tom.machine.memory import STUDIO_CACHE_BYTES
from tom.record.reader import OF_LOOP, Part, RunReader

P = ParamSpec("P")
T = TypeVar("T")

RESULTS: LRUCache[Hashable, tuple[Hashable, Any]] = LRUCache(
    # A result that is larger than the budget is kept alone.
    STUDIO_CACHE_BYTES,
    lambda result: min(bytes_of(result[1]), STUDIO_CACHE_BYTES),
)
LOCK = RLock()
_MAKING: WeakValueDictionary[Hashable, Any] = WeakValueDictionary()
"""by key, the lock of who makes its result"""


def get_or_make(key: tuple[Hashable, ...], version: Hashable, make: Callable[[], T]) -> T:
    """The result for `key`, made if it is not kept in this `version`, whose older one it replaces.

    It is shared and must not be changed. Who asks for what another thread is making waits for it.
    """
    with LOCK:
        making = _MAKING.setdefault(key, RLock())
    with making:
        with LOCK:
            held = RESULTS.get(key)
        if held is not None and held[0] == version:
            return held[1]
        made = make()
        with LOCK:
            RESULTS[key] = version, made
    return made


def cached(*parts: Part) -> Callable[[Callable[P, T]], Callable[P, T]]:
    """Cache a function of runs until one of these parts of them changes.

    Of a part that has steps it is that of the first number. Other arguments are parts of the key;
    one with a `version` is so by its `label`, and a new version of it replaces the old one, too.
    """
    of_loop = {*parts} <= {*OF_LOOP}

    def of(read: Callable[P, T]) -> Callable[P, T]:
        @wraps(read)
        def get(*args: P.args, **kwargs: P.kwargs) -> T:
            assert not kwargs, "a key has no names"
            step = next((one for one in args if isinstance(one, int)), 0)
            key, version = list[Hashable]([read]), list[Hashable]()
            for one in args:
                if isinstance(one, RunReader):
                    key.append(one.home if of_loop else one.path)
                    version += [one.version(part, step) for part in parts]
                else:
                    key.append(getattr(one, "label", one))
                    version.append(getattr(one, "version", None))
            return get_or_make(tuple(key), tuple(version), lambda: read(*args, **kwargs))

        return get

    return of


def bytes_of(value: object) -> int:
    """The approximate bytes of arrays, tables and tensors in `value`, at any depth."""
    size, seen, waiting = 0, set[int](), [value]
    while waiting:
        one = waiting.pop()
        if id(one) in seen:
            continue
        seen.add(id(one))
        if isinstance(one, pd.DataFrame):
            size += 8 * one.size  # of numbers; asking each column takes longer than reading some
            continue
        own = getattr(one, "nbytes", None)  # of arrays and tensors
        size += own if isinstance(own, int) else sys.getsizeof(one, 0)
        if isinstance(one, Mapping):
            waiting += [*one.keys(), *one.values()]
        elif isinstance(one, list | tuple | set | frozenset):
            waiting += one
        elif type(one).__module__.partition(".")[0] in ("tom", "app"):
            waiting += getattr(one, "__dict__", {}).values()
        elif hasattr(one, "parameters"):  # a torch.nn.Module; importing torch takes seconds
            waiting += [*one.parameters(), *one.buffers()]  # pyright: ignore
    return size


ARRAYS = "api/arrays"
MAX_PUBLISHED = 20_000
"""arrays that are known at a time; each page offers its own again when it is drawn"""

_MAKERS: LRUCache[str, Callable[[], NDArray]] = LRUCache(MAX_PUBLISHED)


def publish_array(
    key: tuple[object, ...], make: Callable[[], NDArray], made: NDArray | None = None
) -> str:
    """The address of the array of `key`, which holds its version; `make` should hold no array.

    `made` is that array if a training may soon replace what `make` reads.
    """
    name = hashlib.sha256(repr(key).encode()).hexdigest()[:32]
    with LOCK:
        _MAKERS[name] = make
        if made is not None:
            RESULTS[name] = None, made
    return f"{ARRAYS}/{name}"


def published_array(name: str) -> bytes | None:
    """The bytes of an offered array, little-endian; None if no page has offered it."""
    with LOCK:
        make, held = _MAKERS.get(name), RESULTS.get(name)
    if held is not None:
        return held[1].tobytes()
    return None if make is None else make().tobytes()
