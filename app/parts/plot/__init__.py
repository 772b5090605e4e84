"""A Plotly chart that is updated in place when its data change, so zoom is kept without flicker.

Streamlit's own chart is removed and built again whenever its figure differs.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, Self

import plotly
import plotly.graph_objects as go

from app import parts

LIBRARY = Path(plotly.__file__).parent / "package_data" / "plotly.min.js"
LIBRARY_PATH = f"api/plotly-{plotly.__version__}.js"
_HTML = """<div class="plot-frame"><p class="plot-failed" role="alert" hidden></p>
      <div class="plot" role="group"></div>
      <div class="plot-cursor" aria-hidden="true" hidden></div>
      <div class="plot-crosshair" aria-hidden="true" hidden></div></div>"""
Part = tuple[float, float]


@dataclass(frozen=True)
class Point:
    """A clicked point, bar or cell, and its place in the figure's data."""

    x: Any
    y: Any
    index: Any
    """place in the trace; [row, column] in a heatmap"""
    meta: Any
    """the trace's own `meta`: the run's id on curves"""


@dataclass(frozen=True)
class Follow:
    """How a chart follows the page's timeline, in the browser.

    With `cursor` a line stands at its step on the chart's x axis, which has env steps. `trace`
    has properties of the first trace by step: those of the last that is not after the timeline's
    are shown.
    """

    cursor: bool = False
    trace: Mapping[int, Mapping[str, Any]] | None = None


class View(NamedTuple):
    """The shown part of a figure: (low, high) of each axis in its own units, None for all of it."""

    x: Part | None = None
    y: Part | None = None


@dataclass(frozen=True)
class FigureJson:
    """A figure as the browser gets it, which a page may keep."""

    json: str
    height: int

    @classmethod
    def of(cls, figure: go.Figure) -> Self:
        return cls(figure.to_json(remove_uids=False), int(figure.layout.height or 400))  # type: ignore[attr-defined]


def chart(
    figure: go.Figure | FigureJson,
    key: str,
    label: str,
    clicked: Callable[[Point], None] | None = None,
    *,
    view: View | None = None,
    viewed: Callable[[View], None] | None = None,
    follow: Follow | None = None,
    linked: str = "",
    caption: str = "",
    after: str = "",
) -> None:
    """Show `figure`.

    `label` describes the figure in words, for users who cannot see it, and names the files that a
    user saves. Zoom and hidden lines last while the figure's `uirevision` stays the same. A page
    that stores the zoom itself passes the `view`, and `viewed` is called with each new one. All
    callbacks run before the page is drawn again. With `follow` the chart goes with the page's
    timeline; charts that are `linked` by one name share their zoom along x and the pointer's line.
    `caption` is offered with a saved file, else the label. With `after`, a CSS selector, it lets
    that part of the page draw first.
    """

    drawn = figure if isinstance(figure, FigureJson) else FigureJson.of(figure)
    data = {
        "figure": drawn.json,
        "library": LIBRARY_PATH,
        "label": label,
        "view": view and view._asdict(),
        "follows": follow and vars(follow),
        "linked": linked,
        "caption": caption,
        "after": after,
    }
    parts.draw(
        "plot", _HTML, key, data, drawn.height,
        clicked=lambda event: clicked and clicked(Point(**event)),
        viewed=lambda view: viewed and viewed(View(*(view[of] and tuple(view[of]) for of in "xy"))),
    )  # fmt: skip
