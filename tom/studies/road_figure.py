"""Road-and-rocks: return curves, and the sweep over the rocks' turn."""

from collections.abc import Sequence

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from tom.reports.colours import NEUTRAL, learner_colour
from tom.reports.style import STYLE, new_figure
from tom.studies.road import Outcome, Story

LEARNERS = {"mle": ("mle", "MLE"), "pmac, expert last": ("pmac", "PMAC"), "tom": ("tom", "TOM")}


def return_figure(stories: Sequence[Story]) -> Figure:
    """Return against steps of policy optimisation in the model: mean, range, single seeds."""
    with rc_context(STYLE):
        figure = new_figure(5.2, 3.2)
        ax = figure.subplots()
        for name, (learner, label) in LEARNERS.items():
            curves = [s.returns for s in stories if s.outcome.name == name]
            if curves:
                _curve(
                    ax, np.array(curves), learner_colour(learner), f"{label} (n = {len(curves)})"
                )
        expert = [s.outcome.return_expert for s in stories]
        ax.axhline(float(np.mean(expert)), color=NEUTRAL, linestyle="--", linewidth=0.8)
        ax.set_xlabel("steps of policy optimisation in the model")
        ax.set_ylabel("return in the real task")
        ax.legend()
    return figure


def _curve(ax: Axes, curves: NDArray, colour: str, label: str) -> None:
    """`curves` is (S, T, 2): step and return of S seeds."""
    steps, values = curves[0, :, 0], curves[:, :, 1]
    for single in values:
        ax.plot(steps, single, color=colour, alpha=0.3, linewidth=0.7)
    ax.plot(steps, values.mean(0), color=colour, label=label)


def sweep_figure(outcomes: Sequence[Outcome]) -> Figure:
    """The planner's return in each learner's model as the rocks turn more."""
    with rc_context(STYLE):
        figure = new_figure(5.2, 3.2)
        ax = figure.subplots()
        for name in ("mle", "tom"):
            own = [o for o in outcomes if o.name == name]
            turns = sorted({o.turn for o in own})
            means = [np.mean([o.planner_return for o in own if o.turn == t]) for t in turns]
            colour = learner_colour(name)
            ax.plot([o.turn for o in own], [o.planner_return for o in own], "o",
                    color=colour, alpha=0.35, markersize=3)  # fmt: skip
            ax.plot(turns, means, color=colour, label=name.upper())
        ax.set_xlabel("mean turn of the steering on rocks, degrees")
        ax.set_ylabel("return of the planner")
        ax.legend()
    return figure
