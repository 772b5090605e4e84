"""Return curves: one panel per environment, one line with band per learner."""

from collections.abc import Sequence
from typing import Any

from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from tom.analysis.curves import aggregate
from tom.reports.colours import NEUTRAL, learner_colour
from tom.reports.style import STYLE, new_figure
from tom.studies.returns import Cell, Method, compared_at

COLUMNS = 3
FEW_POINTS = 10
LONG = 26
"""letters of a name, of which two do not fit beside each other"""
LONG_DASHES, DASH_DOT_DOT = (0, (9, 2)), (0, (4, 1.5, 1, 1.5, 1, 1.5))
SOLID, DASHES = "-", ("-.", "--", ":", LONG_DASHES, DASH_DOT_DOT)


def return_figure(cells: Sequence[Cell]) -> Figure:
    """The best return so far, mean over seeds with its 95 % bootstrap band, single seeds faint.

    A dotted line marks the step at which learners are compared.
    """
    at, line = compared_at(cells), _lines(cells)
    rows = -(-len(at) // COLUMNS)
    columns = -(-len(at) // rows)  # four panels are two by two
    with rc_context(STYLE):
        figure = new_figure(3.6 * columns + 0.4, 3.4 * rows + 0.2)
        axes = figure.subplots(rows, columns, squeeze=False).ravel()
        for ax, env in zip(axes, at, strict=False):
            for cell in (c for c in cells if c.env == env):
                _draw(ax, cell, line[cell.method])
            ax.axvline(at[env], color=NEUTRAL, linestyle=":", linewidth=0.9)
            ax.set_title(env)
            ax.set_xlabel("env steps")
            ax.xaxis.set_major_formatter(EngFormatter(sep=""))  # 40k
            names = ax.get_legend_handles_labels()[1]
            ncols = 2 if max(map(len, names)) <= LONG else 1
            below = {"loc": "upper center", "bbox_to_anchor": (0.5, -0.2)}
            ax.legend(fontsize=7.5, ncols=ncols, handlelength=3.2, **below)
        for ax in axes[len(at) :]:
            ax.set_visible(False)
        axes[0].set_ylabel("best return so far")
    return figure


def _lines(cells: Sequence[Cell]) -> dict[Method, Any]:
    """Matplotlib's line style of each method: a learner's variants differ in it."""
    lines: dict[Method, Any] = {}
    for learner, variant in sorted({cell.method for cell in cells}):
        before = sum(known == learner for known, _ in lines)
        lines[learner, variant] = DASHES[before % len(DASHES)] if variant else SOLID
    return lines


def _draw(ax: Axes, cell: Cell, line: Any) -> None:
    colour = learner_colour(cell.learner)
    group = aggregate([curve.best_so_far for curve in cell.curves])
    for curve in group.curves:
        ax.plot(curve.step, curve.value, color=colour, alpha=0.3, linewidth=0.7)
    whole = group.complete
    steps = group.step[whole]
    label = f"{cell.label} (n = {cell.n})"
    marker = "o" if len(steps) < FEW_POINTS else None  # a line needs two points
    mean = group.mean[whole]
    style = {"linestyle": line, "color": colour, "marker": marker, "markersize": 3}
    ax.plot(steps, mean, label=label, **style)
    if cell.n > 1 and len(steps):
        low, high = group.low[whole], group.high[whole]
        ax.fill_between(steps, low, high, color=colour, alpha=0.15, linewidth=0)
