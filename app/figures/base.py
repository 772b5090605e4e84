"""The layout of all figures: margins, axes, hover. Text colours follow the page's theme."""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray

from app.theme import NEUTRAL, faded
from tom.envs import ROAD

ENV_STEPS = "env steps"
ROW, ENTRY, LETTER = 19, 45, 6
"""pixels: a row of a legend, an entry of it without its title, and a letter of the title"""
DASHES = ("solid", "dash", "dot", "dashdot", "longdash", "longdashdot")
"""for lines of one colour"""
GRID = "rgba(128, 138, 158, 0.22)"
MARGINS = 30  # pixels, left and right together
LAYOUT = {
    "margin": {"l": 4, "r": 26, "t": 14, "b": 4},
    "paper_bgcolor": "rgba(0,0,0,0)",
    "plot_bgcolor": "rgba(0,0,0,0)",
    "hovermode": "closest",
    "legend": {
        **{"orientation": "h", "yanchor": "bottom", "y": 1.0, "x": 0, "xanchor": "left"},
        "tracegroupgap": 0,  # rows of groups lie no farther apart than others
    },
    "font": {"size": 12},
}
_AXIS = {"gridcolor": GRID, "zeroline": False, "automargin": True}
X_AXIS = {"showgrid": False, "ticks": "outside", "tickcolor": GRID, **_AXIS}
Y_AXIS = {"title": {"standoff": 8}, **_AXIS}  # else wide tick labels overlap the title


def steps_in_words(envs: Iterable[str]) -> str:
    """The title of a step axis: on a fixed data set, steps are not environment steps."""
    shown = set(envs)
    if ROAD not in shown:
        return ENV_STEPS
    return "steps of policy optimisation" if shown == {ROAD} else "steps"


def styled(
    figure: go.Figure, x: str, height: int, *, keep: str, marks: Sequence[dict] = ()
) -> go.Figure:
    """`figure` with the common layout; the user's zoom is kept as long as `keep` is the same.

    `keep` names what is drawn, such as a run: a zoom on one would show nothing of another.
    The page has the figure's title. `marks` are lines made by `across` and `upright`. Only for a
    figure with one pair of axes and no layout yet, because setting a whole layout takes a third of
    the time of updates.
    """
    figure.layout = go.Layout(
        **LAYOUT,
        height=height,
        uirevision=keep,
        xaxis={"title": {"text": x}, **X_AXIS},
        yaxis=Y_AXIS,
        shapes=list(marks),
    )
    return figure


def across(y: float, width: float, dash: str | None = None) -> dict[str, Any]:
    """A horizontal line at height `y`."""
    ends = {"x0": 0, "x1": 1, "xref": "x domain", "y0": y, "y1": y, "yref": "y"}
    return {"type": "line", **ends, "line": {"color": NEUTRAL, "width": width, "dash": dash}}


def upright(x: float, width: float, dash: str | None = None) -> dict[str, Any]:
    """A vertical line at `x`."""
    ends = {"x0": x, "x1": x, "xref": "x", "y0": 0, "y1": 1, "yref": "y domain"}
    return {"type": "line", **ends, "line": {"color": NEUTRAL, "width": width, "dash": dash}}


def band(
    x: NDArray, low: NDArray, high: NDArray, colour: str, group: str, opacity: float = 0.18
) -> go.Scatter:
    """The area between two lines, which appears and disappears with its group in the legend."""
    return go.Scatter(
        x=np.concatenate([x, x[::-1]]),
        y=np.concatenate([high, low[::-1]]),
        fill="toself",
        fillcolor=faded(colour, opacity),
        line={"width": 0},
        mode="lines",
        hoverinfo="skip",
        legendgroup=group,
        showlegend=False,
    )


def dashes(learners: Sequence[str]) -> list[str]:
    """A dash for each of several lines, another one for each line of the same learner."""
    counts = [learners[:i].count(learner) for i, learner in enumerate(learners)]
    return [DASHES[count % len(DASHES)] for count in counts]


def legend_rows(titles: Iterable[str], width: int) -> int:
    """Rows that a legend with these titles fills in a figure of `width` pixels, about."""
    rows, left = 0, 0
    for title in titles:
        needs = ENTRY + LETTER * len(title)
        if needs > left:
            rows, left = rows + 1, width - MARGINS
        left -= needs
    return rows


def note(figure: go.Figure, text: str, right: float = 1) -> go.Figure:
    """A remark in the figure's corner.

    It ends at `right`, a share of the figure's width.
    """
    figure.add_annotation(
        text=text,
        xref="paper",
        yref="paper",
        x=right,
        y=0,
        xanchor="right",
        yanchor="bottom",
        showarrow=False,
        font={"size": 11},
        opacity=0.75,
    )
    return figure
