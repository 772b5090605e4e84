"""How figures look: colours, style, files, and the panels that several studies draw."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from matplotlib import colormaps, rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, NullLocator
from matplotlib.typing import RcKeyType
from numpy.typing import NDArray

from tom.learners import NEUTRAL, learner_colour

TEXT = "#1c2330"

STYLE: dict[RcKeyType, Any] = {
    "font.size": 9,
    "axes.titlesize": 10,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": TEXT,
    "axes.labelcolor": TEXT,
    "axes.grid": True,
    "grid.alpha": 0.25,
    "grid.linewidth": 0.6,
    "lines.linewidth": 1.4,
    "legend.frameon": False,
    "svg.hashsalt": "tom",  # equal figures give equal files
}


def new_figure(width: float, height: float) -> Figure:
    """An empty figure of `width` x `height` inches."""
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def save(figure: Figure, folder: Path, name: str) -> list[Path]:
    """Write `<name>.png` and `<name>.svg` into `folder`."""
    paths = [folder / f"{name}.png", folder / f"{name}.svg"]
    with rc_context(STYLE):
        figure.savefig(paths[0], dpi=150)
        figure.savefig(paths[1], metadata={"Date": None})
    return paths


def strips(
    colours: Mapping[str, str],
    points: Iterable[tuple[str, str, float]],
    even: float,
    label: str,
    ticks: Sequence[float] = (),
) -> Figure:
    """The values of each row as points and their median as a stroke; a panel a task, or the like.

    `points` are panel, row and value; the rows lie from the top down in the order of `colours`. A
    dashed line is at `even`, where a row is as good as uniform weights. With `ticks` the axis is
    logarithmic.
    """
    values: dict[tuple[str, str], list[float]] = {}
    for panel, row, value in points:
        values.setdefault((panel, row), []).append(value)
    if not values:
        figure = new_figure(4.0, 1.0)
        figure.text(0.5, 0.5, "nothing to draw", ha="center", va="center")
        return figure
    panels = list(dict.fromkeys(panel for panel, _ in values))
    upwards = [name for name in colours if any(row == name for _, row in values)][::-1]
    figure = new_figure(2.2 + 2.6 * len(panels), 0.7 + 0.24 * max(len(upwards), 2))
    axes = figure.subplots(1, len(panels), squeeze=False, sharey=True)[0]
    for ax, panel in zip(axes, panels, strict=True):
        ax.axvline(even, color=NEUTRAL, linewidth=0.8, linestyle="--")
        ax.set_title(panel)
        for height, name in enumerate(upwards):
            of = values.get((panel, name), ())
            ax.scatter(of, [height] * len(of), s=14, color=colours[name], alpha=0.55, linewidths=0)
            if of:
                ax.plot([median(of)] * 2, [height - 0.35, height + 0.35], color=TEXT, linewidth=1.6)
        if ticks:
            ax.set_xscale("log")
            ax.xaxis.set_major_locator(FixedLocator(ticks))
            ax.xaxis.set_minor_locator(NullLocator())
            ax.xaxis.set_major_formatter("{x:g}")
    axes[0].set_yticks(range(len(upwards)), upwards)
    figure.supxlabel(label, size=9)
    return figure


@dataclass(frozen=True)
class Panel:
    """The profiles of one learner, (S, bins), mean weight 1: one row per seed, or per fit."""

    title: str
    learner: str
    profiles: NDArray[np.float64]
    ordered_share: float = 0.0
    """the share of the buffer at which its ordered part begins"""
    fits: Sequence[str] = ()
    """the names of the fits, if the profiles are those of one run, in order"""


def profile_figure(rows: Mapping[str, Sequence[Panel | None]]) -> Figure:
    """One row of panels for each buffer or task in `rows`, the same number of panels in each."""
    columns = max(len(panels) for panels in rows.values())
    with rc_context(STYLE):
        figure = new_figure(2.9 * columns + 0.4, 2.2 * len(rows) + 0.3)
        axes = figure.subplots(len(rows), columns, squeeze=False, sharex=True)
        for line, (name, panels) in zip(axes, rows.items(), strict=True):
            for ax, panel in zip(line, panels, strict=True):
                if panel is None:
                    ax.set(yticks=[])
                    ax.text(0.5, 0.5, "no such run", transform=ax.transAxes, ha="center")
                else:
                    _draw(ax, panel)
            line[0].set_ylabel(f"{name}\nmean weight")
        for ax in axes[-1]:
            ax.set_xlabel("position in the buffer, %")
    return figure


def _draw(ax: Axes, panel: Panel) -> None:
    """A line for each profile: those of seeds faint behind their mean, later fits darker."""
    profiles, share = panel.profiles, panel.ordered_share
    x = (np.arange(profiles.shape[1]) + 0.5) * 100 / profiles.shape[1]
    ax.axhline(1.0, color=NEUTRAL, linewidth=0.8, linestyle="--")
    if share > 0:
        ax.axvspan(0, 100 * share, color=NEUTRAL, alpha=0.12, linewidth=0)
        placed = {"transform": ax.get_xaxis_transform(), "va": "top", "ha": "center"}
        for place, text in ((50 * share, "random"), (50 * (1 + share), "in order of training")):
            ax.text(place, 0.98, text, color=TEXT, alpha=0.7, fontsize=7.5, **placed)
    if panel.fits:
        shades = colormaps["viridis_r"](np.linspace(0.1, 1.0, len(panel.fits)))
        for name, profile, shade in zip(panel.fits, profiles, shades, strict=True):
            ax.plot(x, profile, color=shade, linewidth=1.0, label=name)
        ax.legend(fontsize=6.5, frameon=True, edgecolor="none")  # framed: curves may cross it
    else:
        colour = learner_colour(panel.learner)
        ax.plot(x, profiles.T, color=colour, alpha=0.35, linewidth=0.8)
        ax.plot(x, profiles.mean(0), color=colour)
    ax.set_title(panel.title)
    ax.set_xlim(0, 100)
    ax.set_ylim(0, 1.15 * max(float(np.nanmax(profiles)), 1.0))  # room for the labels
