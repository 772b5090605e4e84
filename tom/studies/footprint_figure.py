"""The distance of each way of weighing from the policy, one point per moment."""

from collections.abc import Sequence
from statistics import median

from matplotlib import rc_context
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, NullLocator

from tom.reports.colours import NEUTRAL, TEXT, learner_colour
from tom.reports.style import STYLE, new_figure
from tom.studies.footprint import UNIFORM, telling
from tom.studies.frozen import WAYS, Outcome

LEAST = 0.03
"""distances below it are drawn at it: the axis is logarithmic"""


def footprint_figure(outcomes: Sequence[Outcome]) -> Figure:
    """One panel per task: distance to the policy relative to uniform weights, log axis.

    Outcomes that say nothing (`telling`) are left out.
    """
    outcomes = telling(outcomes)
    envs = list(dict.fromkeys(one.env for one in outcomes))
    ways = [way for way in WAYS if way != UNIFORM and any(one.way == way for one in outcomes)]
    with rc_context(STYLE):
        figure = new_figure(2.2 + 2.6 * len(envs), 0.7 + 0.24 * len(ways))
        if not envs:
            figure.text(0.5, 0.5, "every distance is lost in noise", ha="center", va="center")
            return figure
        axes = figure.subplots(1, len(envs), squeeze=False, sharey=True)[0]
        for ax, env in zip(axes, envs, strict=True):
            ax.axvline(1.0, color=NEUTRAL, linewidth=0.8, linestyle="--")
            for row, way in enumerate(reversed(ways)):
                of = [max(o.footprint, LEAST) for o in outcomes if (o.env, o.way) == (env, way)]
                colour = learner_colour(WAYS[way].learner or "")
                ax.scatter(of, [row] * len(of), s=14, color=colour, alpha=0.55, linewidths=0)
                if of:
                    ax.plot([median(of)] * 2, [row - 0.35, row + 0.35], color=TEXT, linewidth=1.6)
            ax.set_xscale("log")
            ax.xaxis.set_major_locator(FixedLocator([0.1, 0.2, 0.5, 1, 2, 4]))
            ax.xaxis.set_minor_locator(NullLocator())
            ax.xaxis.set_major_formatter("{x:g}")
            ax.set_title(env)
        axes[0].set_yticks(range(len(ways)), list(reversed(ways)))
        what = "distance to the policy's footprint over that of uniform weights"
        cut = any(one.footprint < LEAST for one in outcomes)
        figure.supxlabel(what + f" (drawn at {LEAST} if below it)" * cut, size=9)
    return figure
