"""What plug-ins have registered besides entries of our own registries."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

Chart = Callable[[Sequence[Any], int], Any]
"""(curves, height) -> a Plotly figure; a curve has `run_id`, `learner`, `step` and `value`."""


@dataclass(frozen=True)
class Page:
    """A page of the studio from a plug-in, with the same attributes as a module of our pages."""

    TITLE: str
    ICON: str
    PATH: str
    page: Callable[[], None]


CHARTS: dict[str, Chart] = {}
PAGES: list[Page] = []
OWNERS: dict[tuple[str, str], str] = {}
"""(kind, name) -> the plug-in's name"""
