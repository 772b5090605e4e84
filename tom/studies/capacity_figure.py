"""Error relative to uniform weights against the capacity of the model."""

from collections.abc import Sequence
from statistics import median

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, NullLocator

from tom.reports.colours import NEUTRAL, learner_colour
from tom.reports.style import STYLE, new_figure
from tom.studies.capacity import AHEAD, Ahead, ratios
from tom.studies.frozen import MODELS, WAYS, Outcome

LINES = ("-", "--", ":", "-.")
SPREAD = 0.09  # between the ways at one model


def capacity_figure(outcomes: Sequence[Outcome]) -> Figure:
    """Errors one step and five steps ahead: median over moments, bars over the middle half."""
    with rc_context(STYLE):
        figure = new_figure(9.0, 3.4)
        axes = figure.subplots(1, len(AHEAD), sharey=True)
        for ax, (ahead, name) in zip(axes, AHEAD.items(), strict=True):
            _draw(ax, outcomes, ahead)
            ax.set_title(f"{name} ahead")
        axes[0].set_ylabel("error over that of uniform weights")
        axes[-1].legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return figure


def _draw(ax: Axes, outcomes: Sequence[Outcome], ahead: Ahead) -> None:
    values = list(ratios(outcomes, ahead))
    models = [model for model in MODELS if any(m == model for _, m, _ in values)]
    ways = [way for way in WAYS if any(one.way == way for one, _, _ in values)]
    drawn: dict[str, int] = {}  # lines of each learner so far
    ax.axhline(1.0, color=NEUTRAL, linewidth=0.8)
    for number, way in enumerate(ways):
        of = [[r for one, m, r in values if (one.way, m) == (way, model)] for model in models]
        middle = np.array([median(group) for group in of])
        low, high = (np.array([np.quantile(group, q) for group in of]) for q in (0.25, 0.75))
        learner = WAYS[way].learner or ""
        ax.errorbar(
            np.arange(len(models)) + SPREAD * (number - (len(ways) - 1) / 2),
            middle,
            yerr=(middle - low, high - middle),
            color=learner_colour(learner),
            linestyle=LINES[drawn.setdefault(learner, 0) % len(LINES)],
            marker="o",
            markersize=4,
            elinewidth=0.8,
            label=way,
        )
        drawn[learner] += 1
    ax.set_yscale("log")
    ax.yaxis.set_major_locator(FixedLocator([0.5, 0.6, 0.7, 0.8, 0.9, 1, 1.1, 1.25, 1.5]))
    ax.yaxis.set_minor_locator(NullLocator())
    ax.yaxis.set_major_formatter("{x:g}")
    ax.set_xticks(range(len(models)), models)
    ax.set_xlabel("model (units x layers)")
