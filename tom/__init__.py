"""TOM Studio's training backend: MBPO with interchangeable model learners.

It knows nothing of the studio (`app`), of Streamlit, Plotly or viser. From Python: `tom.load`,
`tom.weigh` and `tom.studio.show` (docs/notebook.ipynb); `tom.record` and `tom.weigh_live` for a
training loop of one's own (docs/your-own-loop.md).
"""

from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from typing import Any

try:
    __version__ = version("tom-studio")
except PackageNotFoundError:  # running from a source tree that was never installed
    __version__ = "0+unknown"

_FROM = {"load": "tom.frames", "weigh": "tom.frames", "weigh_live": "tom.own_loop.live"}
"""imported on first use, so that commands start quickly"""
_CALLED = ("studio", "record")
"""modules, likewise"""


def __getattr__(name: str) -> Any:
    if name in _CALLED:
        return import_module(f"tom.{name}")
    if name not in _FROM:
        raise AttributeError(f"module 'tom' has no attribute '{name}'")
    return getattr(import_module(_FROM[name]), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *_FROM, *_CALLED])
