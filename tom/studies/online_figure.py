"""Weight profiles at several steps of a run: a panel for each environment and learner."""

from collections.abc import Sequence

import numpy as np
from matplotlib import colormaps, rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from tom.learners import LEARNERS, learner_rank
from tom.reports.colours import NEUTRAL
from tom.reports.style import STYLE, new_figure
from tom.studies.online import RunProfiles


def online_figure(panels: Sequence[RunProfiles]) -> Figure:
    """Mean weight in each hundredth of the buffer, oldest first; later fits are darker."""
    envs = list(dict.fromkeys(panel.run.env for panel in panels))
    learners = sorted({panel.run.learner for panel in panels}, key=learner_rank)
    with rc_context(STYLE):
        figure = new_figure(2.9 * len(learners) + 0.4, 2.2 * len(envs) + 0.3)
        axes = figure.subplots(len(envs), len(learners), squeeze=False)
        for line, env in zip(axes, envs, strict=True):
            for ax, learner in zip(line, learners, strict=True):
                own = [p for p in panels if (p.run.env, p.run.learner) == (env, learner)]
                if own:
                    _draw(ax, own[0])
                else:
                    ax.set(xticks=[], yticks=[])
                    ax.text(0.5, 0.5, "no such run", transform=ax.transAxes, ha="center")
                ax.set_title(LEARNERS[learner].label)
            line[0].set_ylabel(f"{env}\nmean weight")
        for ax in axes[-1]:
            ax.set_xlabel("position in the buffer, %")
    return figure


def _draw(ax: Axes, panel: RunProfiles) -> None:
    bins = panel.bins.shape[1]
    x = (np.arange(bins) + 0.5) * 100 / bins
    shades = colormaps["viridis_r"](np.linspace(0.1, 1.0, len(panel.env_step)))
    ax.axhline(1.0, color=NEUTRAL, linewidth=0.8, linestyle="--")
    for step, profile, shade in zip(panel.env_step, panel.bins, shades, strict=True):
        ax.plot(x, profile, color=shade, linewidth=1.0, label=f"step {step}")
    ax.set_xlim(0, 100)
    ax.set_ylim(bottom=0)
    ax.legend(fontsize=6.5, frameon=True, edgecolor="none")  # framed, because curves may cross it
