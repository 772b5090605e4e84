"""Where do the weights lie in the buffer as a run goes on?

Measures several fits of the store's longest runs of each environment, learner and preset, with its
preset's settings if there are any, and draws one run's (the paper's appendix on online
progression). Leaves out fits with uniform weights, before the learner begins to weigh, and MLE,
which never weighs. Trains nothing.
"""

from argparse import ArgumentParser, Namespace
from collections.abc import Iterator, Sequence
from math import isfinite, nan
from statistics import median
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from tom.analysis.settings import changed
from tom.envs import ENVS, ROAD, task_rank
from tom.errors import UserError
from tom.learners import LEARNERS, SUBJECT, learner_rank
from tom.readable import percent, task_title
from tom.record import RunReader, Store
from tom.reports.figures import Panel, profile_figure
from tom.reports.report import origin_of_runs
from tom.spread import spread
from tom.studies.frozen import LABELS, OF_TOM
from tom.studies.study import Findings, Row, add_groups, add_runs, check_groups, tasks
from tom.studies.verdicts import Point, Tables, Verdict

TITLE = "Weights as a run goes on"
QUESTION = "Does TOM look beyond the newest data while a training goes on?"
CLAIM = (
    "TOM's weights are not high only at the very end of the replay buffer, where data is nearly "
    "optimal: it often pays attention to transitions that were collected at earlier stages, as for "
    "Hopper at step 120 000 and Walker2d at 200 000 (appendix, online progression)."
)
Array = NDArray[Any]
STEPS = 5
LONG = 0.5
"""share of the longest run's steps from which a run of the same settings counts beside it"""
UNIFORM = 0.999  # effective sample size (share) from which weights count as uniform
NEWEST = 0.1
EVEN = 0.1  # excess below which a profile counts as even
CAPTION = "Mean weight in each hundredth of the replay buffer, oldest transitions first."


def add_options(parser: ArgumentParser) -> None:
    add_runs(parser, ENVS, "[all of ours]")
    add_groups(parser)


def find(args: Namespace) -> Findings:
    check_groups(args)
    envs = tasks(args.env)
    runs = [run for run in Store(args.store).runs() if run.env in envs]
    found = panels([run for run in runs if run.learner in args.learner], args.preset)
    if not found:
        raise UserError(
            f"{args.store}/ has no such run that weighed its buffer: tom sweep --env "
            f"{' '.join(envs)} --learner tom pmac vagram --preset {args.preset[0]} makes them"
        )
    profile_rows, drawn = rows(found), first_of_each(found)
    return Findings(
        sentences=in_sentences(profile_rows),
        files={"profiles": _profiles(drawn), "online": profile_rows},
        titles={"online": "Every profile"},
        figures={"online": (CAPTION, online_figure(drawn))},
        origin=origin_of_runs([panel.run for panel in found]),
    )


class RunProfiles(NamedTuple):
    """The weight profiles of one run at F fits: `bins` (F, bins), oldest transitions first."""

    run: RunReader
    label: str
    env_step: Array
    bins: Array
    ess: Array


def panels(runs: Sequence[RunReader], presets: Sequence[str]) -> list[RunProfiles]:
    """The longest runs of each environment, learner and preset that weighed, in that order.

    First the longest, of several the newest, if possible one with its preset's settings; then the
    others with these settings and LONG of its steps.
    """
    suited = [run for run in runs if run.preset in presets and run.env != ROAD]
    as_preset = {run.run_id: not changed(run) for run in suited}
    suited.sort(key=lambda run: (as_preset[run.run_id], run.status.env_step, run.created))

    def place(run: RunReader) -> tuple[object, ...]:
        return task_rank(run.env), learner_rank(run.learner), presets.index(run.preset)

    longest = {place(run): run for run in suited}
    counted = [
        run
        for run in reversed(suited)
        for first in [longest[place(run)]]
        if run is first
        or (as_preset[run.run_id] and run.status.env_step >= LONG * first.status.env_step)
    ]
    found = []
    for run in sorted(counted, key=place):  # type: ignore[arg-type]
        fits = run.profiles()
        weighed = np.flatnonzero((fits.ess < UNIFORM) & np.isfinite(fits.bins).any(1))
        if len(weighed):
            at = weighed[spread(len(weighed), STEPS)]
            preset = "" if run.preset == presets[0] else f", {run.preset}"
            label = LEARNERS[run.learner].label + preset
            found.append(RunProfiles(run, label, fits.env_step[at], fits.bins[at], fits.ess[at]))
    return found


def first_of_each(panels: Sequence[RunProfiles]) -> list[RunProfiles]:
    """The first run of each environment, learner and preset."""
    first = {(one.run.env, one.label): one for one in reversed(panels)}
    return [one for one in panels if first[one.run.env, one.label] is one]


def rows(panels: Sequence[RunProfiles]) -> list[Row]:
    """One row per profile: the share of all weight on the newest tenth of the buffer, the position
    of the bin with the highest mean weight in [0, 1), 0 the oldest, and which share of the weight
    above even weights lies on the newest tenth, NaN if they are nearly even."""
    found = []
    for run, label, env_step, bins, ess in panels:
        newest = slice(-max(round(bins.shape[1] * NEWEST), 1), None)
        even = 1 / np.isfinite(bins).sum(1, keepdims=True)
        excess = np.nan_to_num(np.maximum(bins / np.nansum(bins, 1, keepdims=True) - even, 0))
        for i, above in enumerate(excess):
            found.append(
                {
                    "env": run.env,
                    "learner": label,
                    "seed": run.seed,
                    "step": int(env_step[i]),
                    "newest tenth": float(np.nansum(bins[i, newest]) / np.nansum(bins[i])),
                    "peak at": float(np.nanargmax(bins[i]) / bins.shape[1]),
                    "excess there": float(above[newest].sum() / above.sum())
                    if above.sum() >= EVEN
                    else np.nan,
                    "ess": float(ess[i]),
                    "run": run.run_id,
                }
            )
    return found


def _profiles(panels: Sequence[RunProfiles]) -> Iterator[Row]:
    for run, label, env_step, profiles, _ in panels:
        of = {"env": run.env, "learner": label, "run": run.run_id}
        for step, bins in zip(env_step, profiles, strict=True):
            for number, weight in enumerate(bins.tolist()):
                yield {**of, "step": int(step), "bin": number, "mean_weight": weight}


def in_sentences(rows: Sequence[Row]) -> list[str]:
    """For each learner, how much of its weight is not at the newest end of the buffer."""
    sentences = []
    for name in dict.fromkeys(row["learner"] for row in rows):
        own = [row for row in rows if row["learner"] == name]
        share = [row["newest tenth"] for row in own]
        sentences.append(
            f"{name}: in {sum(one < 0.5 for one in share)} of {len(share)} profiles most weight "
            f"lies outside the newest tenth (median share there {np.median(share):.2f}), and in "
            f"{sum(row['peak at'] < 1 - NEWEST for row in own)} the peak does; "
            f"{len({row['run'] for row in own})} runs."
        )
    return sentences


def verdict(tables: Tables) -> Verdict:
    """By what most of TOM's profiles show; there is no test of single runs.

    Most weight lies before the newest tenth if it is even, too. So what counts is the excess over
    even weights. Raises ValueError if all profiles are nearly even.
    """
    rows = [row for row in tables["online"] if row["learner"] in OF_TOM]
    uneven = [row["excess there"] for row in rows if isfinite(row["excess there"])]
    if not uneven:
        raise ValueError("nothing to judge")
    early = sum(share < 0.5 for share in uneven)
    sentence = (
        f"In {early} of {len(uneven)} profiles most of the weight above even weights lies before "
        "the newest tenth of the buffer, which has "
        f"{percent(median(row['newest tenth'] for row in rows), 0)} of all weight (median)."
    )
    runs = {row["run"] for row in rows}
    against = (
        f"{len(runs)} runs, whose fits are alike: there is no test. The latest is of step "
        f"{max(row['step'] for row in rows):,}; the paper's are of steps 120,000 and 200,000."
    )
    points = []
    for env, name in dict.fromkeys((row["env"], row["learner"]) for row in rows):
        share = median(
            row["newest tenth"] for row in rows if (row["env"], row["learner"]) == (env, name)
        )
        way = OF_TOM[name]
        points.append(Point(task_title(env), LABELS[way], share, nan, nan, SUBJECT, way))
    axis = "weight on the newest tenth (0.1: even weights)"
    side = (2 * early > len(uneven)) - (2 * early < len(uneven))
    word = {1: "Yes", 0: "In part", -1: "No"}[side]
    return Verdict(word, sentence, against, axis, 0.1, points)


def online_figure(panels: Sequence[RunProfiles]) -> Figure:
    """A row for each environment, a column for each learner and preset; later fits are darker."""
    drawn: dict[str, dict[str, Panel]] = {}
    for run, label, env_step, bins, _ in panels:
        fits = [f"step {step}" for step in env_step]
        drawn.setdefault(run.env, {})[label] = Panel(label, run.learner, bins, fits=fits)
    columns = [
        label for _, label in sorted({(learner_rank(p.run.learner), p.label) for p in panels})
    ]
    return profile_figure({env: [of.get(label) for label in columns] for env, of in drawn.items()})
