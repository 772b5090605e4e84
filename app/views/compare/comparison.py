"""The runs that are compared, their groups, and which of them are hidden."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import streamlit as st

from app import session
from app.data.called import names, short_names
from app.figures.curves import Look, looks_of
from app.parts import address
from app.parts.eyes import Item, Row
from tom.analysis.curves import Group
from tom.analysis.settings import USUAL, Kind, kinds_of
from tom.record.reader import RunReader

HIDE = "hide"
ALIKE = 0.9
"""runs whose last steps differ by less have ended at about the same step"""


@dataclass(frozen=True)
class Comparison:
    """Runs, the kind of each (by id), and the look of each kind, including hidden ones.

    `hidden` holds titles of groups and ids of runs. A hidden run does not count in its group.
    """

    runs: tuple[RunReader, ...]
    by: str
    kinds: Mapping[str, Kind]
    looks: Mapping[Kind, Look]
    hidden: tuple[str, ...]

    @property
    def members(self) -> list[RunReader]:
        """The runs that count in their group: not hidden themselves, and not cut short."""
        cut = self.cut_short
        return [run for run in self.runs if run.run_id not in self.hidden and run not in cut]

    @property
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
            and run.status.env_step < ALIKE * ends.get((run.env, self.kinds[run.run_id]), 0)
        ]

    @property
    def shown(self) -> list[RunReader]:
        """The runs that are hidden neither themselves nor with their group."""
        off = self.hidden_kinds
        return [run for run in self.members if self.kinds[run.run_id] not in off]

    @property
    def hidden_kinds(self) -> list[Kind]:
        """The groups that are hidden."""
        return [kind for kind, look in self.looks.items() if look.title in self.hidden]

    @property
    def only_seeds_differ(self) -> bool:
        """Whether the runs of a group differ in nothing but the seed."""
        return self.by == USUAL

    @property
    def unit(self) -> str:
        """What the n of a group counts."""
        return "seeds" if self.only_seeds_differ else "runs"

    def twice(self, grouped: Sequence[Group]) -> str:
        """A remark if a seed was run twice in a group; else empty."""
        repeated = any(len({curve.seed for curve in group.curves}) < group.n for group in grouped)
        repeated &= self.only_seeds_differ
        return "A seed that was run twice counts twice." if repeated else ""

    def rows(self) -> list[Row]:
        """The list beside the figure: one row per group, with its runs."""
        several = len({run.env for run in self.runs}) > 1
        called = names(self.runs) if several else short_names(self.runs)
        for run in self.cut_short:
            called[run.run_id] += f", ended at {run.status.env_step:,}: left out"
        rows = []
        for kind, look in self.looks.items():
            mine = [run for run in self.runs if self.kinds[run.run_id] == kind]
            items = [
                Item(run.run_id, called[run.run_id], run.run_id in self.hidden)
                for run in sorted(mine, key=lambda run: (run.env, run.seed))
            ]
            rows.append(Row(look, look.title in self.hidden, items))
        return rows


def compare(runs: Sequence[RunReader], by: str) -> Comparison:
    """Group the runs, and read from the page or its address which of them are hidden."""
    kinds = kinds_of(runs, by)
    look_of = looks_of([(run.env, kinds[run.run_id]) for run in runs], by, session.mode())
    there = {run.run_id for run in runs} | {look.title for look in look_of.values()}
    hidden = [word for word in address.value_of(HIDE, list) if word in there]
    address.keep(HIDE, hidden)
    return Comparison(tuple(runs), by, kinds, look_of, tuple(hidden))


def hide(words: Sequence[str]) -> None:
    """Hide these groups (titles) and runs (ids), and no others, from now on."""
    st.session_state[HIDE] = list(words)


def toggled(hidden: Collection[str], word: str) -> list[str]:
    """`hidden` with one group or run added, or removed if it was there."""
    others = [other for other in hidden if other != word]
    return others if word in hidden else [*others, word]


def switched(hidden: Collection[str], off: Collection[str], among: Collection[str]) -> list[str]:
    """`hidden` with the words of `among` that are in `off`, and without the others of `among`."""
    return [*(w for w in hidden if w not in among), *(w for w in among if w in off)]
