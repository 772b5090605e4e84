"""Where do the weights lie in the buffer as a run goes on?

The profiles of several fits of the longest run of each environment and learner that the store has
(the paper's appendix on online progression). Fits with uniform weights, before the learner begins
to weigh, are left out, and so is MLE, which never weighs. Nothing is trained.
"""

from argparse import ArgumentParser, Namespace
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from tom.envs import ENVS, ROAD, task_rank
from tom.errors import UserError
from tom.learners import LEARNERS, learner_rank
from tom.record import RunReader, Store
from tom.reports.figures import NEUTRAL, new_figure
from tom.reports.report import origin_of_runs
from tom.studies.returns_cells import PAPER_ENVS
from tom.studies.study import (
    Findings,
    Lab,
    Row,
    Study,
    Table,
    add_env,
    add_store,
    check_known,
    tasks,
)
from tom.training.presets import PRESETS

Array = NDArray[Any]
STEPS = 5
UNIFORM = 0.999  # effective sample size (share) from which weights count as uniform
NEWEST = 0.1
EVEN = 0.1  # excess below which a profile counts as even
CAPTION = "Mean weight in each hundredth of the replay buffer, oldest transitions first."


def add_options(parser: ArgumentParser) -> None:
    add_env(parser, list(ENVS), "[all of ours]")
    parser.add_argument("--preset", default="paper", metavar="PRESET", help="[paper]")
    add_store(parser)


def find(args: Namespace, lab: Lab) -> Findings:
    check_known("preset", [args.preset], PRESETS)
    envs = tasks(args.env)
    found = panels([run for run in Store(args.store).runs() if run.env in envs], args.preset)
    if not found:
        raise UserError(
            f"{args.store}/ has no such run that weighed its buffer: tom sweep --env "
            f"{' '.join(envs)} --learner tom pmac vagram --preset {args.preset} makes them"
        )
    table = rows(found)
    return Findings(
        said=verdict(found),
        files={"profiles": _profiles(found), "online": table},
        figures={"online": (CAPTION, partial(online_figure, found))},
        tables=[Table("Every profile", table)],
        origin=origin_of_runs([panel.run for panel in found]),
        json={"rows": table},
    )


@dataclass(frozen=True)
class RunProfiles:
    """The weight profiles of one run at F fits: `bins` (F, bins), oldest transitions first."""

    run: RunReader
    env_step: Array
    bins: Array
    ess: Array

    @property
    def newest(self) -> slice:
        """The newest tenth of the bins, one at the least."""
        return slice(-max(round(self.bins.shape[1] * NEWEST), 1), None)

    @property
    def share_newest(self) -> Array:
        """Share of all weight on the newest tenth of the buffer, (F,)."""
        return np.nansum(self.bins[:, self.newest], 1) / np.nansum(self.bins, 1)

    @property
    def excess(self) -> Array:
        """The share of all weight that each bin has above its even share, (F, bins)."""
        even = 1 / np.isfinite(self.bins).sum(1, keepdims=True)
        share = self.bins / np.nansum(self.bins, 1, keepdims=True)
        return np.nan_to_num(np.maximum(share - even, 0))

    @property
    def peak(self) -> Array:
        """Position in [0, 1) of the bin with the highest mean weight, 0 the oldest, (F,)."""
        return np.nanargmax(self.bins, 1) / self.bins.shape[1]


def panels(runs: Sequence[RunReader], preset: str) -> list[RunProfiles]:
    """The longest run of each environment and learner, if it weighed, in the registry's order."""
    longest: dict[tuple[str, str], RunReader] = {}
    for run in sorted(runs, key=lambda run: (run.status.env_step, run.created)):
        if run.preset == preset and run.env != ROAD and run.learner in LEARNERS:
            longest[run.env, run.learner] = run
    order = sorted(longest, key=lambda pair: (task_rank(pair[0]), learner_rank(pair[1])))
    found = []
    for run in (longest[pair] for pair in order):
        fits = run.profiles()
        weighed = np.flatnonzero((fits.ess < UNIFORM) & np.isfinite(fits.bins).any(1))
        if len(weighed):
            spread = np.linspace(0, len(weighed) - 1, min(STEPS, len(weighed))).round()
            chosen = weighed[spread.astype(int)]
            kept = fits.env_step[chosen], fits.bins[chosen], fits.ess[chosen]
            found.append(RunProfiles(run, *kept))
    return found


def rows(panels: Sequence[RunProfiles]) -> list[Row]:
    """One row per profile: where its weight is."""
    return [
        {
            "env": panel.run.env,
            "learner": LEARNERS[panel.run.learner].label,
            "seed": panel.run.seed,
            "step": int(panel.env_step[i]),
            "newest tenth": float(panel.share_newest[i]),
            "peak at": float(panel.peak[i]),
            "ess": float(panel.ess[i]),
            "run": panel.run.run_id,
        }
        for panel in panels
        for i in range(len(panel.env_step))
    ]


def _profiles(panels: Sequence[RunProfiles]) -> Iterator[Row]:
    for panel in panels:
        run = {"env": panel.run.env, "learner": panel.run.learner, "run": panel.run.run_id}
        for step, bins in zip(panel.env_step, panel.bins, strict=True):
            for number, weight in enumerate(bins.tolist()):
                yield {**run, "step": int(step), "bin": number, "mean_weight": weight}


def verdict(panels: Sequence[RunProfiles]) -> list[str]:
    """For each learner, how much of its weight is not at the newest end of the buffer.

    That is also true of even weights. So the paper's claim is tested on profiles that are not even,
    and on their excess over even weights, in the paper's tasks.
    """
    said = []
    for name in dict.fromkeys(panel.run.learner for panel in panels):
        own = [panel for panel in panels if panel.run.learner == name]
        share = np.concatenate([panel.share_newest for panel in own])
        peak = np.concatenate([panel.peak for panel in own])
        said.append(
            f"{LEARNERS[name].label}: in {int((share < 0.5).sum())} of {len(share)} profiles most "
            f"weight lies outside the newest tenth (median share there {np.median(share):.2f}), "
            f"and in {int((peak < 1 - NEWEST).sum())} the peak does; {len(own)} runs, "
            f"{len(own)} environments, one seed each."
        )
        of_paper = [panel for panel in own if panel.run.env in PAPER_ENVS]
        if name == "tom" and of_paper:
            said.append(_held_against_paper(of_paper))
    return said


def _held_against_paper(panels: Sequence[RunProfiles]) -> str:
    """Whether most uneven profiles have most of their excess before the newest tenth."""
    newest = [
        excess[panel.newest].sum() / excess.sum()
        for panel in panels
        for excess in panel.excess
        if excess.sum() >= EVEN
    ]
    if not newest:
        return "All of TOM's are nearly even: nothing to hold against the paper."
    agree = sum(share < 0.5 for share in newest)
    says = ("Half of them is no verdict.", "So the paper says.", "The paper says otherwise.")
    return (
        f"What lies above even weights lies mostly before the newest tenth in {agree} of the "
        f"{len(newest)} profiles of TOM that are not nearly even. "
        f"{says[int(np.sign(2 * agree - len(newest)))]}"
    )


def online_figure(panels: Sequence[RunProfiles]) -> Figure:
    """A panel for each environment and learner; later fits are darker."""
    envs = list(dict.fromkeys(panel.run.env for panel in panels))
    learners = sorted({panel.run.learner for panel in panels}, key=learner_rank)
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


STUDY = Study(
    "online",
    "Weights as a run goes on",
    __doc__,
    "TOM's weights are not high only at the very end of the replay buffer, where data is nearly "
    "optimal: it often pays attention to transitions that were collected at earlier stages, as for "
    "Hopper at step 120 000 and Walker2d at 200 000 (appendix, online progression).",
    add_options,
    find,
)
