"""The studies of `tom reproduce`: one file and one name here each.

A study's file is imported when it is needed: it draws with matplotlib.
"""

from importlib import import_module
from types import ModuleType

STUDIES = (
    "road",
    "progression",
    "footprint",
    "capacity",
    "improvement",
    "online",
    "returns",
    "tabular",
)
"""in the order of listing"""


def load(name: str) -> ModuleType:
    """The study `name` of STUDIES."""
    return import_module(f"{__name__}.{name}")
