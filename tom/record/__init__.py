"""The record of a run: files hold all of it, Rerun is only a view. It never slows training.

This package exports the reading of runs. The modules that write (`recorder`, `writer`,
`rerun.sink`) are imported separately, so that a reader does not load them; and the readers come
with their first use, so that a server which only passes files on does not load pandas.

Called, it is `tom.record(...)`: the record of a training loop of the user's own (tom/own_loop).
"""

import sys
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tom.record.reader import RunReader
    from tom.record.store import Store

__all__ = ["RunReader", "Store"]
_MODULES = {"RunReader": "reader", "Store": "store"}


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__} has no {name}")
    found = getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
    globals()[name] = found
    return found


class _Called(ModuleType):
    def __call__(self, *args: Any, **options: Any) -> Any:
        return import_module("tom.own_loop.run").record(*args, **options)


sys.modules[__name__].__class__ = _Called
