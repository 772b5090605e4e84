"""The time and disk space that a sweep will need, estimated from similar finished runs."""

from collections.abc import Sequence
from dataclasses import dataclass
from heapq import heapreplace
from statistics import median

from tom.record import RunReader
from tom.record.files import size_of
from tom.training.plan import Trial

SAMPLES = 5  # maximum number of finished runs per environment and learner


@dataclass(frozen=True)
class Cost:
    """The expected cost of one training; `source` names the runs of the estimate."""

    hours: float
    megabytes: float
    source: str


def cost(trial: Trial, runs: Sequence[RunReader], done: int = 0) -> Cost | None:
    """The cost of `trial` from finished runs of the same environment and preset; None without any.

    For a run that is resumed at step `done` only the rest counts. Runs of the same learner are
    preferred to those of others. Time and disk space are proportional to the steps; a longer run
    also fits a larger buffer, so an estimate from a short run is a lower bound.
    """
    ended = [run for run in runs if run.status.state == "finished" and run.fits_model]
    # A small copy has fewer bytes than its run.
    whole = [run for run in ended if not run.small_copy]
    like = [run for run in whole if (run.env, run.preset) == (trial.env, trial.preset)]
    same = [run for run in like if run.learner == trial.learner]
    chosen = (same or like)[:SAMPLES]
    costs: list[tuple[float, float]] = []  # seconds and bytes of an env step
    for run in chosen:
        table = run.metrics()
        if "time/wall_s" not in table or not run.status.env_step:
            continue
        known = table[["env_step", "time/wall_s"]].dropna().to_numpy()
        # Exploration itself costs almost nothing.
        trained = known[known[:, 0] >= run.given.get("exploration_steps", 0)]
        if len(trained) >= 2 and trained[-1, 0] > trained[0, 0]:
            passed, spent = trained[-1] - trained[0]
            costs.append((spent / passed, size_of(run.path) / run.status.env_step))
    if not costs:
        return None
    seconds, written = (median(values) for values in zip(*costs, strict=True))
    steps = trial.config.total_steps
    left = max(steps - max(done, getattr(trial.config, "exploration_steps", 0)), 0)
    other = "" if same else f" of {chosen[0].learner}"
    source = f"{len(costs)} run{'s' if len(costs) > 1 else ''}{other}"
    return Cost(seconds * left / 3600, written * max(steps - done, 0) / 1e6, source)


def makespan(hours: Sequence[float], slots: int) -> float:
    """Hours until the last of these runs ends, if they start in order, `slots` at a time."""
    ends = [0.0] * slots
    for run in hours:
        heapreplace(ends, ends[0] + run)
    return max(ends)
