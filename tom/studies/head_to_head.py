"""Two ways of weighing at the same moments: which one is better, and by how much?

Two ways share the buffer, the policy and its fresh episodes at a moment, and moments differ far
more than ways do. The difference at each moment is therefore known much better than either way.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import isfinite, nan
from statistics import median

from tom.analysis.statistics import Interval
from tom.studies.frozen import Outcome
from tom.studies.recordings import Signs, Value, over_recordings, sign_test

QUESTIONS: dict[tuple[str, str], str] = {
    ("tom-discounted", "uniform"): "Is TOM as printed better than no weights?",
    ("tom-mended", "uniform"): "Is the mended one?",
    ("half-tom-mended", "uniform"): "Is it, if half of its weight is uniform?",
    ("half-recency", "uniform"): "Is recency, if half of its weight is uniform?",
    ("tom-mended", "tom-discounted"): "Is the mended objective better than the printed one?",
    ("tom-mended", "ratio"): "Does Q bring something on top of the discriminator?",
    ("tom-mended", "recency"): "Is TOM better than recency, which trains no network?",
    ("half-tom-mended", "half-recency"): "Is it better than recency, if half of either is uniform?",
    ("tom-stationary-validated", "tom-stationary"): "Is it better to stop Q on held-out episodes?",
    ("tom-stationary-validated", "tom-discounted-validated"): "Does the flow matter?",
}
"""what is asked of two ways: the first one, and the one that it has to beat"""


@dataclass(frozen=True)
class Comparison:
    """The difference of two ways over `n` moments; below zero the first one is better."""

    way: str
    against: str
    difference: Interval
    better: int  # moments
    n: int
    recordings: Signs
    by_task: Mapping[str, float]
    """the difference in each task, of which `difference` is the mean; NaN without a moment there"""

    @property
    def by_recording(self) -> dict[str, float]:
        """The columns of a table: on how many recordings the first is better, and the sign test."""
        of = self.recordings
        return {"better on": of.below, "recordings": of.n, "p": of.p}


def comparisons(
    outcomes: Sequence[Outcome], value: Callable[[Outcome], float]
) -> Iterator[Comparison]:
    """Each pair of `QUESTIONS` at the moments that both were examined at.

    `value` is what is compared, lower is better; moments where it is NaN do not count. The
    difference at a moment is the median over seeds.
    """
    at = {(one.way, *_trial(one)): value(one) for one in outcomes}
    for way, against in QUESTIONS:
        trials: dict[tuple[str, str, int], list[float]] = {}
        for one in outcomes:
            gap = value(one) - at.get((against, *_trial(one)), nan)
            if one.way == way and isfinite(gap):
                trials.setdefault((one.env, one.recording, one.step), []).append(gap)
        gaps: list[Value] = [(env, of, median(each)) for (env, of, _), each in trials.items()]
        if gaps:
            better = sum(gap < 0 for _, _, gap in gaps)
            difference, signs = over_recordings(gaps), sign_test(gaps)
            tasks = {env: _in_task(gaps, env) for env in dict.fromkeys(one.env for one in outcomes)}
            yield Comparison(way, against, difference, better, len(gaps), signs, tasks)


def _in_task(gaps: Sequence[Value], env: str) -> float:
    here = [gap for gap in gaps if gap[0] == env]
    return over_recordings(here).value if here else nan


def _trial(one: Outcome) -> tuple[str, int, int]:
    return one.recording, one.step, one.seed
