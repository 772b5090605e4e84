"""A Plotly chart that is updated in place when its data change, so zoom is kept without flicker.

Streamlit's own chart is removed and built again whenever its figure differs.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Self

import plotly
import plotly.graph_objects as go
import streamlit as st

from app.parts.component import renderer

LIBRARY = Path(plotly.__file__).parent / "package_data" / "plotly.min.js"
LIBRARY_PATH = f"api/plotly-{plotly.__version__}.js"
_HTML = """<div class="plot-frame"><p class="plot-failed" role="alert" hidden></p>
      <div class="plot" role="img"></div>
      <div class="plot-cursor" aria-hidden="true" hidden></div>
      <div class="plot-crosshair" aria-hidden="true" hidden></div></div>"""


@dataclass(frozen=True)
class Point:
    """A clicked point, bar or cell, and its place in the figure's data."""

    x: Any
    y: Any
    index: int | tuple[int, int]
    """place in the trace; (row, column) in a heatmap"""
    meta: Any
    """the trace's own `meta`: the run's id on curves"""

    @classmethod
    def of(cls, message: Mapping[str, Any]) -> Self:
        index = message["index"]
        index = (int(index[0]), int(index[1])) if isinstance(index, list) else int(index)
        return cls(message["x"], message["y"], index, message["meta"])


@dataclass(frozen=True)
class Region:
    """The content of a box or a lasso; `points` are (trace, index in the trace)."""

    points: tuple[tuple[int, int], ...]
    outline: tuple[tuple[float, float], ...]
    """corners (x, y) of the box or lasso that was drawn last, in the figure's units"""

    @classmethod
    def of(cls, message: Mapping[str, Any]) -> Self:
        points = tuple((int(trace), int(index)) for trace, index in message["points"])
        return cls(points, tuple((float(x), float(y)) for x, y in message["outline"]))


@dataclass(frozen=True)
class Follow:
    """How a chart follows the page's timeline, in the browser.

    With `cursor` a line stands at its step on the chart's x axis, which has env steps. `traces`
    (place in the figure: the trace's y, or properties of it by name, at each of `steps`, ascending)
    shows the last of them that is not after the timeline's step.
    """

    cursor: bool = False
    steps: Sequence[int] = ()
    traces: Mapping[int, Sequence[Sequence[float] | Mapping[str, Any]]] | None = None

    def message(self) -> dict[str, Any]:
        """What the browser gets."""
        traces = [{"index": index, "y": y} for index, y in (self.traces or {}).items()]
        return {"cursor": self.cursor, "steps": list(self.steps), "traces": traces or None}


@dataclass(frozen=True)
class View:
    """The shown part of a figure: (low, high) of each axis in its own units, None for all of it."""

    x: tuple[float, float] | None = None
    y: tuple[float, float] | None = None

    @classmethod
    def of(cls, message: Mapping[str, Any]) -> Self:
        x, y = ((float(p[0]), float(p[1])) if p else None for p in (message["x"], message["y"]))
        return cls(x, y)


@dataclass(frozen=True)
class Drawn:
    """A figure as the browser gets it, which a page may keep."""

    json: str
    height: int

    @classmethod
    def of(cls, figure: go.Figure) -> Self:
        return cls(figure.to_json(remove_uids=False), int(figure.layout.height or 400))  # type: ignore[attr-defined]


def chart(
    figure: go.Figure | Drawn,
    key: str,
    label: str,
    clicked: Callable[[Point], None] | None = None,
    selected: Callable[[Region | None], None] | None = None,
    *,
    view: View | None = None,
    viewed: Callable[[View], None] | None = None,
    follow: Follow | None = None,
    linked: str = "",
    caption: str = "",
) -> None:
    """Show `figure`.

    `label` describes the figure in words, for users who cannot see it, and names the files that a
    user saves. With `selected` the figure has box and lasso; it is called with None when the
    selection is cleared. Zoom, selection and hidden lines last while the figure's `uirevision`
    stays the same. A page that stores the zoom itself passes the `view`, and `viewed` is called
    with each new one. All callbacks run before the page is drawn again. With `follow` the chart
    goes with the page's timeline; charts that are `linked` by one name share their zoom along x
    and the pointer's line. `caption` is offered with a saved file, else the label.
    """

    def on_click() -> None:
        message = st.session_state[key].get("clicked")
        if clicked is not None and message is not None:
            clicked(Point.of(message))

    def on_select() -> None:
        message = st.session_state[key].get("selected")
        if selected is not None and message is not None:
            selected(Region.of(message) if message["points"] or message["outline"] else None)

    def on_view() -> None:
        message = st.session_state[key].get("viewed")
        if viewed is not None and message is not None:
            viewed(View.of(message))

    drawn = figure if isinstance(figure, Drawn) else Drawn.of(figure)
    data = {
        "figure": drawn.json,
        "library": LIBRARY_PATH,
        "label": label,
        "selects": selected is not None,
        "view": asdict(view) if view else None,
        "follows": follow.message() if follow else None,
        "linked": linked,
        "caption": caption,
    }
    renderer("plot", _HTML)(
        key=key,
        data=data,
        height=drawn.height,
        on_clicked_change=on_click,
        on_selected_change=on_select,
        on_viewed_change=on_view,
    )
