"""Where the weights lie in the replay buffer as a run goes on (the paper's appendix E).

One run for each environment and learner: the longest. Fits before the learner began to weigh,
whose weights are all one, are left out; so is MLE, which never does.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tom.envs import ENVS
from tom.learners import LEARNER_NAMES, LEARNERS
from tom.record import RunReader

STEPS = 5
UNIFORM = 0.999  # effective share of the buffer from which weights count as uniform
NEWEST = 0.1


@dataclass(frozen=True)
class Panel:
    """The weight profiles of one run at F fits: `bins` (F, bins), oldest transitions first."""

    run: RunReader
    env_step: NDArray[np.int64]
    bins: NDArray[np.float64]
    ess: NDArray[np.float64]

    @property
    def share_newest(self) -> NDArray[np.float64]:
        """Share of all weight on the newest tenth of the buffer, (F,)."""
        newest = round(self.bins.shape[1] * NEWEST)
        return np.nansum(self.bins[:, -newest:], 1) / np.nansum(self.bins, 1)

    @property
    def peak(self) -> NDArray[np.float64]:
        """Position in [0, 1) of the bin with the highest mean weight, 0 the oldest, (F,)."""
        return np.nanargmax(self.bins, 1) / self.bins.shape[1]


def panels(runs: Sequence[RunReader], preset: str) -> list[Panel]:
    """The longest run of each environment and learner that weighed, in the registry's order."""
    longest: dict[tuple[str, str], RunReader] = {}
    for run in sorted(runs, key=lambda run: (run.status.env_step, run.created)):
        if run.config.get("preset") == preset:
            longest[run.env, run.learner] = run
    pairs = [(env, name) for env in ENVS for name in LEARNER_NAMES if (env, name) in longest]
    found = [_panel(longest[pair]) for pair in pairs]
    return [panel for panel in found if panel is not None]


def rows(found: Sequence[Panel]) -> list[dict[str, Any]]:
    """A row a profile: where its weight lies."""
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
        for panel in found
        for i in range(len(panel.env_step))
    ]


def verdict(found: Sequence[Panel]) -> list[str]:
    """For each learner, how much of its weight lies elsewhere than at the buffer's newest end."""
    lines = []
    for name in dict.fromkeys(panel.run.learner for panel in found):
        own = [panel for panel in found if panel.run.learner == name]
        share = np.concatenate([panel.share_newest for panel in own])
        peak = np.concatenate([panel.peak for panel in own])
        lines.append(
            f"{LEARNERS[name].label}: in {int((share < 0.5).sum())} of {len(share)} profiles most "
            f"weight lies outside the newest tenth (median share there {np.median(share):.2f}), "
            f"and in {int((peak < 1 - NEWEST).sum())} the peak does; {len(own)} runs, "
            f"{len(own)} environments, one seed each."
        )
        if name == "tom":
            agrees = (share < 0.5).mean() > 0.5
            lines[-1] += " So the paper says." if agrees else " The paper says otherwise."
    return lines


def _panel(run: RunReader) -> Panel | None:
    profiles = run.profiles()
    weighed = np.flatnonzero((profiles.ess < UNIFORM) & np.isfinite(profiles.bins).any(1))
    if not len(weighed):
        return None
    spread = np.linspace(0, len(weighed) - 1, min(STEPS, len(weighed))).round().astype(int)
    chosen = weighed[spread]
    return Panel(run, profiles.env_step[chosen], profiles.bins[chosen], profiles.ess[chosen])
