"""Which runs are compared: those of one task, in groups that differ in one thing alone.

The studio's pages and `tom answer` group here, so that they cannot disagree.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

from tom.analysis.settings import USUAL, Kind, kinds_of
from tom.config import SAC_ALONE
from tom.learners import LEARNERS, SUBJECT, learner_label, learner_rank
from tom.record.reader import RunReader
from tom.training.presets import default_preset

CUT_SHORT = 0.9
"""runs whose last steps differ by less have ended at about the same step"""
SHOWN_GROUPS = 6
"""groups that are shown until the user opens more"""


@dataclass(frozen=True)
class RunGroups:
    """Runs, newest first, in groups with titles, main ones first; and which are hidden.

    `hidden` holds titles of groups and ids of runs. A hidden run does not count in its group.
    """

    runs: tuple[RunReader, ...]
    by: str
    kinds: dict[str, Kind]
    """of each run, by its id"""
    titles: dict[Kind, str]
    folded: frozenset[str]
    """titles of the groups that are hidden until the user opens them"""
    hidden: frozenset[str]

    @cached_property
    def counted(self) -> list[RunReader]:
        """The runs that count in their group: not hidden themselves, and not cut short."""
        cut = {run.run_id for run in self.cut_short}
        return [run for run in self.runs if run.run_id not in self.hidden | cut]

    @cached_property
    def cut_short(self) -> list[RunReader]:
        """Runs that ended well before a finished one of their group, and do not go on."""
        ends: dict[tuple[str, Kind], int] = {}
        for run in self.runs:
            if run.status.state == "finished":
                key = run.env, self.kinds[run.run_id]
                ends[key] = max(ends.get(key, 0), run.status.env_step)
        return [
            run
            for run in self.runs
            if run.status.state != "finished"
            and not run.status.alive
            and run.status.env_step < CUT_SHORT * ends.get((run.env, self.kinds[run.run_id]), 0)
        ]

    @cached_property
    def shown(self) -> list[RunReader]:
        """The runs that are hidden neither themselves nor with their group."""
        return [run for run in self.counted if self.title(run) not in self.hidden]

    @property
    def order(self) -> tuple[str, ...]:
        """The titles of the groups, main ones first."""
        return tuple(self.titles.values())

    def title(self, run: RunReader) -> str:
        return self.titles[self.kinds[run.run_id]]

    def comparable(self, chosen_id: str = "") -> dict[str, list[RunReader]]:
        """The shown runs of one task that fit a model, by their group's title: weighing ones first.

        The task and the first group are those of the chosen run, if it is one of them.
        """
        runs = [run for run in self.shown if run.fits_model]
        runs = runs or [run for run in self.counted if run.fits_model]
        chosen = next((run for run in runs if run.run_id == chosen_id), None)
        groups: dict[str, list[RunReader]] = {}
        for run in runs:
            if run.env == (chosen or runs[0]).env:
                groups.setdefault(self.title(run), []).append(run)
        first = self.title(chosen) if chosen else ""
        order = sorted(
            (title for title in self.order if title in groups),
            key=lambda title: (title != first, has_uniform_learner(groups[title][0])),
        )
        return {title: groups[title] for title in order}


def grouped(runs: Sequence[RunReader], by: str = USUAL) -> RunGroups:
    """The runs, newest first, in groups as usual or by a setting.

    Hidden are the groups beyond the main ones, and examples beside runs of one's own: these form
    groups of their own.
    """
    kinds = kinds_of(runs, by)
    own = {kinds[run.run_id] for run in runs if not run.small_copy}
    for run in runs:
        kind = kinds[run.run_id]
        if run.small_copy and kind in own:
            variant = ", ".join(filter(None, (kind.variant, "example")))
            kinds[run.run_id] = kind._replace(variant=variant)
    titles = titles_of(kinds.values())
    rank = {kinds[run.run_id]: _rank(run, kinds[run.run_id]) for run in runs}
    order = sorted(titles, key=lambda kind: rank[kind])
    main = [kind for kind in order if kind in own or not own][:SHOWN_GROUPS]
    folded = frozenset(titles[kind] for kind in order if kind not in main)
    in_order = {kind: titles[kind] for kind in order}
    return RunGroups(tuple(runs), by, kinds, in_order, folded, hidden=folded)


def titles_of(kinds: Iterable[Kind]) -> dict[Kind, str]:
    """The title of each: the learner, such as `TOM`, its preset if it has several, the settings."""
    found = dict.fromkeys(kinds)
    presets = {learner: {k.preset for k in found if k.learner == learner} for learner, *_ in found}
    titles = {}
    for kind in found:
        preset = kind.preset if len(presets[kind.learner]) > 1 or not kind.learner else ""
        name = " ".join(filter(None, (learner_label(kind.learner), preset)))
        titles[kind] = ", ".join(filter(None, (name, kind.variant)))
    return titles


def _rank(run: RunReader, kind: Kind) -> tuple[object, ...]:
    usual = run.preset == default_preset(run.env, run.learner)
    return (
        bool(kind.variant), run.learner == SAC_ALONE, not usual, run.learner != SUBJECT,
        learner_rank(run.learner), kind,
    )  # fmt: skip


def usual_task(runs: Sequence[RunReader]) -> str:
    """The task of the newest training of one's own, else that of most examples.

    Of one's own runs, recordings of SAC count if there is nothing else. `runs` are newest first,
    at least one.
    """
    own = [run for run in runs if not run.small_copy]
    if own:
        return next((run for run in own if run.fits_model), own[0]).env
    tasks = [run.env for run in runs]
    return max(dict.fromkeys(tasks), key=tasks.count)


def usual_other(groups: dict[str, list[RunReader]], one: str) -> str | None:
    """The title of the group that `one` is compared with: one that weighs nothing, if there is."""
    others = [title for title in groups if title != one]
    uniform = (title for title in others if has_uniform_learner(groups[title][0]))
    return next(uniform, others[0] if others else None)


def has_uniform_learner(run: RunReader) -> bool:
    """Whether the run's learner counts every transition the same."""
    return run.learner in LEARNERS and LEARNERS[run.learner].uniform
