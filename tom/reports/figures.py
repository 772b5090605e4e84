"""How figures look: colours, style, files, and the weight profiles of an ordered buffer."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, NullLocator
from matplotlib.typing import RcKeyType
from numpy.typing import NDArray

from tom.learners import LEARNERS

NEUTRAL = "#8a92a3"
TEXT = "#1c2330"


def learner_colour(learner: str) -> str:
    """The colour of a learner; a neutral one if it has none."""
    entry = LEARNERS.get(learner)
    return entry.colour if entry and entry.colour else NEUTRAL


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


def log_ticks(axis: Axis, ticks: Sequence[float]) -> None:
    """Only these ticks on a logarithmic axis, as plain numbers."""
    axis.set_major_locator(FixedLocator(ticks))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter("{x:g}")


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
    nothing: str,
) -> Figure:
    """One panel per task: the values of each row as points, their median as a stroke.

    `points` are task, row and value; the rows lie from the top down in the order of `colours`. A
    dashed line is where a way is as good as uniform weights. `nothing` is said without points.
    """
    values: dict[tuple[str, str], list[float]] = {}
    for env, row, value in points:
        values.setdefault((env, row), []).append(value)
    if not values:
        figure = new_figure(4.0, 1.0)
        figure.text(0.5, 0.5, nothing, ha="center", va="center")
        return figure
    envs = list(dict.fromkeys(env for env, _ in values))
    upwards = [name for name in colours if any(row == name for _, row in values)][::-1]
    figure = new_figure(2.2 + 2.6 * len(envs), 0.7 + 0.24 * max(len(upwards), 2))
    axes = figure.subplots(1, len(envs), squeeze=False, sharey=True)[0]
    for ax, env in zip(axes, envs, strict=True):
        ax.axvline(even, color=NEUTRAL, linewidth=0.8, linestyle="--")
        ax.set_title(env)
        for height, name in enumerate(upwards):
            of = values.get((env, name), ())
            ax.scatter(of, [height] * len(of), s=14, color=colours[name], alpha=0.55, linewidths=0)
            if of:
                ax.plot([median(of)] * 2, [height - 0.35, height + 0.35], color=TEXT, linewidth=1.6)
    axes[0].set_yticks(range(len(upwards)), upwards)
    figure.supxlabel(label, size=9)
    return figure


@dataclass(frozen=True)
class Panel:
    """The profiles of one learner, (S, bins), one row per seed, mean weight 1."""

    title: str
    learner: str
    profiles: NDArray[np.float64]


def profile_figure(
    rows: Mapping[str, Sequence[Panel]], ordered_share: Mapping[str, float]
) -> Figure:
    """One row of panels for each buffer in `rows`, the same number of panels in each.

    `ordered_share` is the share of the buffer at which its ordered part begins.
    """
    columns = max(len(panels) for panels in rows.values())
    with rc_context(STYLE):
        figure = new_figure(2.9 * columns + 0.4, 2.2 * len(rows) + 0.3)
        axes = figure.subplots(len(rows), columns, squeeze=False, sharex=True)
        for line, (name, panels) in zip(axes, rows.items(), strict=True):
            for ax, panel in zip(line, panels, strict=True):
                _draw(ax, panel, ordered_share[name])
            line[0].set_ylabel(f"{name}\nmean weight")
        for ax in axes[-1]:
            ax.set_xlabel("position in the buffer, %")
    return figure


def _draw(ax: Axes, panel: Panel, ordered_share: float) -> None:
    bins = panel.profiles.shape[1]
    x = (np.arange(bins) + 0.5) * 100 / bins
    colour = learner_colour(panel.learner)
    ax.axhline(1.0, color=NEUTRAL, linewidth=0.8, linestyle="--")
    if ordered_share > 0:
        ax.axvspan(0, 100 * ordered_share, color=NEUTRAL, alpha=0.12, linewidth=0)
        _label(ax, 50 * ordered_share, "random")
        _label(ax, 50 * (1 + ordered_share), "in order of training")
    for profile in panel.profiles:
        ax.plot(x, profile, color=colour, alpha=0.35, linewidth=0.8)
    ax.plot(x, panel.profiles.mean(0), color=colour)
    ax.set_title(panel.title)
    ax.set_xlim(0, 100)
    ax.set_ylim(0, 1.15 * max(float(panel.profiles.max()), 1.0))  # room for the labels


def _label(ax: Axes, x: float, text: str) -> None:
    placed = {"transform": ax.get_xaxis_transform(), "va": "top", "ha": "center"}
    ax.text(x, 0.98, text, color=TEXT, alpha=0.7, fontsize=7.5, **placed)
