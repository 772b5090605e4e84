"""Estimated against exact weights of small MDPs, one panel per divergence and discount."""

from collections.abc import Iterator, Sequence

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure

from tom.reports.colours import NEUTRAL, learner_colour
from tom.reports.style import STYLE, new_figure
from tom.studies.tabular import Estimate

LABELS = {"chi2": "chi-square", "kl": "KL", "full-chi2": "full chi-square"}


def estimate_figure(estimates: Sequence[Estimate]) -> Figure:
    """Every distinct transition as a point whose area is its share of the replay."""
    kinds = sorted({(e.case.divergence, e.case.discount) for e in estimates})
    with rc_context(STYLE):
        figure = new_figure(2.6 * len(kinds) + 0.3, 3.0)
        axes = figure.subplots(1, len(kinds), squeeze=False)[0]
        for ax, kind in zip(axes, kinds, strict=True):
            own = [e for e in estimates if (e.case.divergence, e.case.discount) == kind]
            exact = np.concatenate([e.exact for e in own])
            estimated = np.concatenate([e.estimated for e in own])
            share = np.concatenate([e.replay for e in own])
            drawn = np.isfinite(estimated)
            top = 1.05 * float(max(exact[drawn].max(), estimated[drawn].max()))
            ax.plot([0, top], [0, top], color=NEUTRAL, linewidth=0.8, linestyle="--")
            ax.scatter(
                exact[drawn],
                estimated[drawn],
                s=400 * share[drawn],
                color=learner_colour("tom"),
                alpha=0.35,
                linewidths=0,
            )
            ax.set_title(f"{LABELS[kind[0]]}, discount {kind[1]:g}")
            ax.set_xlabel("exact weight")
        axes[0].set_ylabel("estimated weight")
    return figure


def estimate_rows(estimates: Sequence[Estimate]) -> Iterator[dict[str, object]]:
    """The drawn data: one row per distinct transition in the replay."""
    for e in estimates:
        case = e.case
        key = {"divergence": case.divergence, "discount": case.discount, "seed": case.seed}
        key["successors"] = case.successors
        points = zip(e.exact, e.estimated, e.replay, strict=True)
        for exact, estimated, share in points:
            if np.isfinite(estimated):
                yield {**key, "exact": exact, "estimated": estimated, "replay's share": share}
