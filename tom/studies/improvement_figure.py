"""What each way of weighing does to the return: its difference to uniform weights, by task."""

from collections.abc import Sequence
from statistics import median

from matplotlib import rc_context
from matplotlib.figure import Figure

from tom.reports.colours import NEUTRAL, TEXT, learner_colour
from tom.reports.style import STYLE, new_figure
from tom.studies.footprint import UNIFORM
from tom.studies.frozen import WAYS
from tom.studies.improvement import Improvement
from tom.studies.improvement_summary import PLACES, gaps


def improvement_figure(found: Sequence[Improvement]) -> Figure:
    """One panel per task: a row for every way and each place where its weights act."""
    envs = list(dict.fromkeys(one.env for one in found))
    ways = [way for way in WAYS if way != UNIFORM and any(one.way == way for one in found)]
    rows = [(way, place) for way in ways for place in PLACES][::-1]
    with rc_context(STYLE):
        figure = new_figure(2.2 + 2.6 * len(envs), 0.9 + 0.24 * max(len(rows), 2))
        axes = figure.subplots(1, len(envs), squeeze=False, sharey=True)[0]
        for ax, env in zip(axes, envs, strict=True):
            ax.axvline(0.0, color=NEUTRAL, linewidth=0.8, linestyle="--")
            for row, (way, place) in enumerate(rows):
                of = [gap for task, _, gap in gaps(found, way, place) if task == env]
                colour = learner_colour(WAYS[way].learner or "")
                ax.scatter(of, [row] * len(of), s=14, color=colour, alpha=0.55, linewidths=0)
                if of:
                    ax.plot([median(of)] * 2, [row - 0.35, row + 0.35], color=TEXT, linewidth=1.6)
            ax.set_xscale("symlog", linthresh=100)
            ax.set_title(env)
        axes[0].set_yticks(range(len(rows)), [f"{way}, {place}" for way, place in rows])
        figure.supxlabel("return less that with uniform weights", size=9)
    return figure
