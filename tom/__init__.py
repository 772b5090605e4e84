"""TOM Studio's training backend: MBPO with interchangeable model learners.

It knows nothing of the studio (`app`), of Streamlit, Plotly or viser. From Python: `tom.load`,
`tom.weigh` and `tom.studio.show` (docs/notebook.ipynb).
"""

from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from typing import Any

try:
    __version__ = version("tom-studio")
except PackageNotFoundError:  # running from a source tree that was never installed
    __version__ = "0+unknown"

_FROM = {"load": "tom.frames", "weigh": "tom.frames"}
"""imported on first use, so that commands start quickly"""


def __getattr__(name: str) -> Any:
    if name == "studio":
        return import_module("tom.studio")
    if name not in _FROM:
        raise AttributeError(f"module 'tom' has no attribute '{name}'")
    return getattr(import_module(_FROM[name]), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *_FROM, "studio"])
