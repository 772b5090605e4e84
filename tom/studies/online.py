"""The distribution of weights over the replay buffer during a run (the paper's appendix D).

For each environment and learner the longest run is used. Fits with uniform weights, before the
learner begins to weigh, are left out, and so is MLE, which never weighs.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tom.envs import ROAD, task_rank
from tom.learners import LEARNERS, learner_rank
from tom.record import RunReader
from tom.studies.returns import PAPER_ENVS

STEPS = 5
UNIFORM = 0.999  # effective sample size (share) from which weights count as uniform
NEWEST = 0.1
EVEN = 0.1  # excess below which a profile counts as even


@dataclass(frozen=True)
class RunProfiles:
    """The weight profiles of one run at F fits: `bins` (F, bins), oldest transitions first."""

    run: RunReader
    env_step: NDArray[np.int64]
    bins: NDArray[np.float64]
    ess: NDArray[np.float64]

    @property
    def share_newest(self) -> NDArray[np.float64]:
        """Share of all weight on the newest tenth of the buffer, (F,)."""
        return np.nansum(self.bins[:, self._newest], 1) / np.nansum(self.bins, 1)

    @property
    def excess(self) -> NDArray[np.float64]:
        """Share of all weight above even weights, (F,): 0 where every bin has the same."""
        return self._above().sum(1)

    @property
    def excess_newest(self) -> NDArray[np.float64]:
        """The share of the excess on the newest tenth, (F,); 0 without excess."""
        above = self._above()
        return above[:, self._newest].sum(1) / np.maximum(above.sum(1), np.finfo(float).tiny)

    @property
    def _newest(self) -> slice:
        """The newest tenth of the bins, one at the least."""
        return slice(-max(round(self.bins.shape[1] * NEWEST), 1), None)

    def _above(self) -> NDArray[np.float64]:
        """The weight of each bin above its even share, (F, bins)."""
        share = self.bins / np.nansum(self.bins, 1, keepdims=True)
        even = 1 / np.isfinite(self.bins).sum(1, keepdims=True)
        return np.nan_to_num(np.maximum(share - even, 0))

    @property
    def peak(self) -> NDArray[np.float64]:
        """Position in [0, 1) of the bin with the highest mean weight, 0 the oldest, (F,)."""
        return np.nanargmax(self.bins, 1) / self.bins.shape[1]


def panels(runs: Sequence[RunReader], preset: str) -> list[RunProfiles]:
    """The longest run of each environment and learner, if it weighed, in the registry's order."""
    longest: dict[tuple[str, str], RunReader] = {}
    for run in sorted(runs, key=lambda run: (run.status.env_step, run.created)):
        if run.preset == preset and run.env != ROAD and run.learner in LEARNERS:
            longest[run.env, run.learner] = run
    order = sorted(longest, key=lambda pair: (task_rank(pair[0]), learner_rank(pair[1])))
    every = [_panel(longest[pair]) for pair in order]
    return [panel for panel in every if panel is not None]


def rows(panels: Sequence[RunProfiles]) -> list[dict[str, Any]]:
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


def verdict(panels: Sequence[RunProfiles]) -> list[str]:
    """For each learner, how much of its weight is not at the newest end of the buffer.

    That is also true of even weights. So the paper's claim is tested on profiles that are not even,
    and on their excess over even weights, in the paper's tasks.
    """
    lines = []
    for name in dict.fromkeys(panel.run.learner for panel in panels):
        own = [panel for panel in panels if panel.run.learner == name]
        share = np.concatenate([panel.share_newest for panel in own])
        peak = np.concatenate([panel.peak for panel in own])
        lines.append(
            f"{LEARNERS[name].label}: in {int((share < 0.5).sum())} of {len(share)} profiles most "
            f"weight lies outside the newest tenth (median share there {np.median(share):.2f}), "
            f"and in {int((peak < 1 - NEWEST).sum())} the peak does; {len(own)} runs, "
            f"{len(own)} environments, one seed each."
        )
        of_paper = [panel for panel in own if panel.run.env in PAPER_ENVS]
        if name == "tom" and of_paper:
            lines[-1] += _held_against_paper(of_paper)
    return lines


def _held_against_paper(panels: Sequence[RunProfiles]) -> str:
    """Whether most uneven profiles have most of their excess before the newest tenth."""
    excess = np.concatenate([panel.excess for panel in panels])
    newest = np.concatenate([panel.excess_newest for panel in panels])[excess >= EVEN]
    if not len(newest):
        return " All are nearly even: nothing to hold against the paper."
    agree = int((newest < 0.5).sum())
    says = {
        1: "So the paper says.",
        0: "Half of them is no verdict.",
        -1: "The paper says otherwise.",
    }
    sign = int(np.sign(2 * agree - len(newest)))
    return (
        f" What lies above even weights lies mostly before the newest tenth in {agree} of the "
        f"{len(newest)} profiles that are not nearly even. {says[sign]}"
    )


def _panel(run: RunReader) -> RunProfiles | None:
    profiles = run.profiles()
    weighed = np.flatnonzero((profiles.ess < UNIFORM) & np.isfinite(profiles.bins).any(1))
    if not len(weighed):
        return None
    spread = np.linspace(0, len(weighed) - 1, min(STEPS, len(weighed))).round().astype(int)
    chosen = weighed[spread]
    return RunProfiles(run, profiles.env_step[chosen], profiles.bins[chosen], profiles.ess[chosen])
