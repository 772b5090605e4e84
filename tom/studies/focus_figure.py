"""Every learner's model error relative to MLE's, one panel per recording."""

from collections.abc import Sequence

from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, NullLocator

from tom.reports.colours import NEUTRAL, learner_colour
from tom.reports.style import STYLE, new_figure
from tom.studies.focus import QUANTITIES, Focus

MARKERS = {"tom mended": "^", "tom exact": "D"}
LABELS = {
    "pmac": "PMAC",
    "tom paper": "TOM, paper preset",
    "tom mended": "TOM, mended preset",
    "tom exact": "TOM, exact preset",
}
TICKS = {
    "policy": "policy's\nown",
    "policy_rollout": "own,\n5 steps",
    "ordered": "ordered\nhalf",
    "random": "random\nhalf",
}
SPREAD = 0.18  # between the learners of one quantity


def error_figure(results: Sequence[Focus]) -> Figure:
    """One point per seed: the error relative to MLE's with the same seed (1: no difference)."""
    recordings = list(dict.fromkeys(f.recording for f in results))
    with rc_context(STYLE):
        figure = new_figure(2.9 * len(recordings) + 1.5, 2.8)
        axes = figure.subplots(1, len(recordings), squeeze=False, sharey=True)[0]
        for ax, name in zip(axes, recordings, strict=True):
            _draw(ax, [f for f in results if f.recording == name])
            ax.set_title(name)
        axes[0].set_ylabel("model error over MLE's")
        axes[-1].legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return figure


def _draw(ax: Axes, results: Sequence[Focus]) -> None:
    ax.axhline(1.0, color=NEUTRAL, linewidth=0.8, linestyle="--")
    mle = {f.seed: f for f in results if f.rival == "mle"}
    rivals = [r for r in dict.fromkeys(f.rival for f in results) if r != "mle"]
    for shift, rival in enumerate(rivals):
        of = [f for f in results if f.rival == rival]
        x = [
            q + SPREAD * (shift - (len(rivals) - 1) / 2) for q in range(len(QUANTITIES)) for _ in of
        ]
        y = [getattr(f, q) / getattr(mle[f.seed], q) for q in QUANTITIES for f in of]
        colour = learner_colour(rival.split()[0])
        ax.scatter(
            x,
            y,
            s=22,
            color=colour,
            marker=MARKERS.get(rival, "o"),
            label=LABELS.get(rival, rival),
            alpha=0.8,
        )
    ax.set_yscale("log")
    ax.set_xticks(range(len(QUANTITIES)), [TICKS[q] for q in QUANTITIES])
    ax.yaxis.set_major_locator(FixedLocator([0.5, 0.75, 1, 1.5, 2, 3, 4]))
    ax.yaxis.set_minor_locator(NullLocator())
    ax.yaxis.set_major_formatter("{x:g}")
