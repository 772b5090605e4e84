"""Weight profiles of an ordered buffer, one panel per learner."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from tom.reports.colours import NEUTRAL, TEXT, learner_colour
from tom.reports.style import STYLE, new_figure


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
