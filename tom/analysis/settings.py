"""The settings of runs: in what they differ, and which runs form one group.

A page and a report group here, so that they cannot disagree.
"""

import math
import re
from collections.abc import Sequence
from contextlib import suppress
from typing import NamedTuple

from tom.errors import UserError
from tom.learners import others_groups
from tom.readable import Settings, in_words
from tom.record import RunReader
from tom.training.presets import resolve

# They do not change a run's numbers, or at most its length.
NEUTRAL_SETTINGS = {"seed", "steps", "checkpoint_every", "snapshots", "bins", "threads"}
NEUTRAL_SETTINGS |= {"device", "matmul", "env", "learner", "preset"}
NONE = "-"


def differences(runs: Sequence[RunReader]) -> dict[str, list[str]]:
    """The settings in which the runs differ: path to the values, in the order of the runs."""
    settings = [run.settings for run in runs]
    paths = sorted({path for one in settings for path in one})
    rows = {path: [one.get(path, NONE) for one in settings] for path in paths}
    return {path: words for path, words in rows.items() if len(set(words)) > 1}


def distinguishing_presets(kinds: Sequence[RunReader]) -> list[str]:
    """The preset of each, empty if its learner has only one preset in its task."""
    used: dict[tuple[str, str], set[str]] = {}
    for one in kinds:
        used.setdefault((one.env, one.learner), set()).add(one.preset)
    return [one.preset if len(used[one.env, one.learner]) > 1 else "" for one in kinds]


def variants(runs: Sequence[RunReader]) -> dict[str, str]:
    """For each run id, its differences from the runs of the same environment, learner and preset.

    Empty if only the seed differs. Settings that a run's version did not have yet do not count, nor
    do settings of other learners. A value that is the preset's own is not named.
    """
    kinds: dict[tuple[str, str, str], list[RunReader]] = {}
    for run in runs:
        kinds.setdefault((run.env, run.learner, run.preset), []).append(run)
    variant_of: dict[str, str] = {}
    for (env, learner, preset), group_runs in kinds.items():
        differing = {
            path: words
            for path, words in differences(group_runs).items()
            if affects_results(path, learner) and len(set(words) - {NONE}) > 1
        }
        own: Settings = {}
        with suppress(UserError):  # a task, learner or preset that is not known here
            own = in_words(resolve(env, learner, preset).model_dump(mode="json"))
        for i, run in enumerate(group_runs):
            words = [f"{path} {of[i]}" for path, of in differing.items() if of[i] != own.get(path)]
            variant_of[run.run_id] = ", ".join(words)
    return variant_of


def changed(run: RunReader) -> dict[str, str]:
    """The settings in which a run differs from its preset: path to value.

    Only settings that matter to its learner and exist both in this version and in the run's.
    """
    usual = in_words(resolve(run.env, run.learner, run.preset).model_dump(mode="json"))
    return {
        path: words
        for path, words in run.settings.items()
        if affects_results(path, run.learner) and words != usual.get(path, words)
    }


def differing_settings(runs: Sequence[RunReader]) -> list[str]:
    """Paths of the settings that not all of these runs have, or have changed, in the same way.

    Learners differ by their own settings, and so do two presets of one: those count only if a run
    has changed them.
    """
    every = []
    for run in runs:
        preset = in_words(resolve(run.env, "mle", run.preset).model_dump(mode="json"))
        shared = {path: words for path, words in preset.items() if affects_results(path, "mle")}
        every.append((shared, changed(run)))
    paths = sorted({path for one in every for part in one for path in part})
    return [p for p in paths if len({(of.get(p), new.get(p)) for of, new in every}) > 1]


def affects_results(path: str, learner: str) -> bool:
    """Whether a setting changes the numbers of a run of this learner."""
    return path not in NEUTRAL_SETTINGS and path.partition(".")[0] not in others_groups(learner)


USUAL = "all but the seed"
"""runs of a group differ only in the seed and in settings that change no number"""
_NUMBER = re.compile(r"(\d+(?:\.\d+)?(?:e[+-]?\d+)?)")


class Kind(NamedTuple):
    """What the runs of a group have in common; a part is empty if they may differ in it."""

    learner: str = ""
    preset: str = ""
    variant: str = ""
    """settings and their values, in words"""


def choices(runs: Sequence[RunReader]) -> list[str]:
    """The ways to group `runs`: as usual, or by a setting in which some of them differ.

    The environment is not among them, because no figure has runs of two. A setting of only some
    learners is among them if the runs of these learners differ in it.
    """
    values_of: dict[str, set[str]] = {}
    for run in runs:
        others = others_groups(run.learner)
        for path, words in run.settings.items():
            if path.partition(".")[0] not in others and words != NONE:
                values_of.setdefault(path, set()).add(words)
    paths = {path for path, values in values_of.items() if len(values) > 1} - {"env"}
    first = [path for path in ("learner", "preset") if path in paths]
    return [USUAL, *first, *sorted(paths.difference(first))]


def kinds_of(runs: Sequence[RunReader], by: str = USUAL) -> dict[str, Kind]:
    """The kind of each run, by its id.

    If they are grouped by a setting, runs with the same value form a group, even if they differ
    in other settings. Runs without a value, or of a learner without that setting, stay in their
    usual groups.
    """
    if by == "learner":
        return {run.run_id: Kind(learner=run.learner) for run in runs}
    if by == "preset":
        return {run.run_id: Kind(preset=run.preset) for run in runs}
    variant_of, found = variants(runs), {}
    for run in runs:
        found[run.run_id] = Kind(run.learner, run.preset, variant_of[run.run_id])
        words = run.settings.get(by, NONE)
        if words != NONE and by.partition(".")[0] not in others_groups(run.learner):
            found[run.run_id] = Kind(variant=f"{by} {words}")
    return found


def number(kind: Kind, by: str) -> float | None:
    """The value of the setting by which a kind was grouped; None if it is not a number."""
    try:
        value = float(kind.variant.removeprefix(f"{by} "))
    except ValueError:
        return None
    return value if kind.variant.startswith(f"{by} ") and math.isfinite(value) else None


def natural_sort_key(text: str) -> list[tuple[float, str]]:
    """A sort key in which 64 comes before 128."""
    parts = enumerate(_NUMBER.split(text))
    return [(float(part), "") if i % 2 else (-1.0, part) for i, part in parts]
