"""The runs that every page is about: those of the list at the left, its filters and its eyes."""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as compute
import streamlit as st

from app import parts, session, text
from app.data import readers
from app.data.run_names import distinct_names, full_names, task_title
from app.figures.curves import Style, styles_of
from app.parts import address, widgets
from tom.analysis.curves import curve_points
from tom.analysis.grouping import RunGroups, grouped, usual_task
from tom.analysis.settings import USUAL, Kind, choices
from tom.learners import learner_label
from tom.readable import score
from tom.record.files import modified
from tom.record.reader import RunReader
from tom.spread import spread

POLL_S = 5
"""seconds between two looks at whether a training has begun or ended"""
LISTED, SPARKS = 200, 24
"""runs that the list names, and points of a run's small line"""
EVERY_TASK = "every task"
FILTERS: dict[str, tuple[str, Callable[[RunReader], Collection[str]], Callable[[str], str]]] = {
    "state": ("State", lambda run: [run.shown], str),
    "learner": ("Learner", lambda run: [run.learner], learner_label),
    "preset": ("Preset", lambda run: [run.preset], str),
    "tag": ("Tag", lambda run: run.labels.tags, str),
}
"""by the name in the address: label, the values of a run, and how they are shown"""
CALLS = {
    "weights": "`run.weights` records them, `tom.weigh_live(run)` computes them",
    "rows": "`run.transitions` records them",
    "evaluations": "`run.evaluate` plays them, `run.episode` records yours",
}
"""what a loop of one's own calls for its record to have a part"""
KEYS = {
    "Space": "play or pause the timeline",
    "← →": "one fit or evaluation back or forward",
    "/": "search the runs",
    "?": "this help",
    "Alt + eye": "show a run or a group alone",
    "Back": "the previous view",
}
_HELP = "".join(f"<dt><kbd>{key}</kbd></dt><dd>{what}</dd>" for key, what in KEYS.items())
_FRAME = f"""<div class="frame"><button type="button" class="theme"></button>
      <button type="button" class="help">Shortcuts</button>
      <button type="button" class="ask">Notify me when a training ends</button>
      <dialog aria-label="Shortcuts"><h2>Shortcuts</h2><dl>{_HELP}</dl>
      <form method="dialog"><button autofocus>Close</button></form></dialog></div>"""
_LIST = '<div class="runlist" role="group" aria-label="Runs"></div>'
ALIVE = "frame: alive"
"""the trainings that ran when this session last looked"""


@dataclass(frozen=True)
class Scope(RunGroups):
    """The runs that pass the filters, in groups, with the choices and colours of this session."""

    chosen_id: str
    """the id of the run that the user has chosen; empty if none"""
    styles: Mapping[Kind, Style]

    @property
    def unit(self) -> str:
        """What the n of a group counts: seeds, if its runs differ in nothing else."""
        return "seeds" if self.by == USUAL else "runs"

    def choose_run(
        self, suits: Callable[[RunReader], bool], sort_key: Callable[[RunReader], object]
    ) -> RunReader | None:
        """The chosen run, if it suits; else, of the shown runs that suit, that with the least
        `usual`; else of all; None if none does."""
        chosen = [run for run in self.runs if run.run_id == self.chosen_id]
        for runs in (chosen, self.shown, self.runs):
            suited = [run for run in runs if suits(run)]
            if suited:
                return min(suited, key=sort_key)  # type: ignore[arg-type]
        return None

    def show_missing(self, shown: RunReader | None, part: str) -> None:
        """Say what the chosen run of a loop of one's own lacks here, and which call would give it.

        `shown` is the run that the page shows, None if it shows none.
        """
        loops = [run for run in self.runs if run.own_loop]
        asked = [run for run in loops if run.run_id == self.chosen_id]
        for run in asked or ([] if shown else loops[:1]):
            if shown is None or shown.run_id != run.run_id:
                st.caption(f"{text.markdown(run.run_id)} has no {part}: {CALLS[part]}.")


def draw() -> Scope:
    """The list of runs, with its filters, in the sidebar."""
    store = session.links().store
    everything = readers.listing(store).runs
    with st.sidebar:
        asked = address.get("run")
        of_task = _runs_of_task(everything, asked)
        if asked and all(run.run_id != asked for run in everything):
            from app.data import weighings  # here: few addresses need it

            if asked in readers.trashed(store):
                st.warning(f"Run {text.markdown(asked)} is in the trash: Curves, Runs restores it.")
            elif all(one.run_id != asked for one in weighings.datasets(store)):
                st.warning(f"There is no run {text.markdown(asked)} in this store.")
        words = address.text_input(
            "Search", "find", placeholder="search: a regular expression",
            label_visibility="collapsed", icon=":material/search:",
        )  # fmt: skip
        with st.popover("Filter and group", icon=":material/filter_alt:", width="stretch"):
            by = address.choose_one(st.selectbox, "Group by", choices(of_task), "group", USUAL)
            runs = of_task
            for field, (label, values, shown) in FILTERS.items():
                # A chosen one stays, also if the last run of that state has just ended.
                chosen = st.session_state.get(field, ())
                options = sorted({value for run in of_task for value in values(run)}.union(chosen))
                picked = {*address.choose_many(label, options, field, shown, placeholder="any")}
                runs = [run for run in runs if not picked or picked.intersection(values(run))]
        runs = matching(runs, words)
        scope = _scope(runs, by)
        if everything and not runs:
            st.info("No run passes these filters.", icon=":material/filter_alt_off:")
        _draw_list(scope)
        frame(everything)
        widgets.redraw_when_changed(lambda: store_state(store), POLL_S)
    return scope


def store_state(store: str) -> object:
    """What changes when a run begins, goes on, has fitted, was evaluated, ends or is labelled."""
    runs = readers.listing(store).runs
    alive = [run for run in runs if run.status.alive]
    now = [(run.run_id, run.version("profiles"), run.evaluation_steps()) for run in alive]
    return modified(Path(store)), now, [run.labels for run in runs]


def _runs_of_task(everything: Sequence[RunReader], asked: str) -> list[RunReader]:
    """The runs of the chosen task: usually the chosen run's, else `usual_task`."""
    if not everything:  # there may be weighed data
        return []
    first = next((run.env for run in everything if run.run_id == asked), usual_task(everything))
    tasks = {run.env for run in everything}
    env = address.choose_one(
        st.selectbox, "Task", [*sorted(tasks), EVERY_TASK], "task", first,
        lambda name: name if name == EVERY_TASK else task_title(name), label_visibility="collapsed",
    )  # fmt: skip
    title = "" if env == EVERY_TASK else task_title(env)
    st.session_state["task shown"] = title  # in the window's title
    return [run for run in everything if env in (EVERY_TASK, run.env)]


def matching(runs: Sequence[RunReader], pattern: str) -> list[RunReader]:
    """The runs whose name or id contains a match of the regular expression `pattern`.

    If it is malformed, all runs are returned and the page says why. The expression may come from a
    link, so it is matched in time linear in the names, unlike by Python's `re`.
    """
    # (?m): the beginning and the end of the id are those of a line, and so are those of the name.
    options = compute.MatchSubstringOptions(f"(?m){pattern}", ignore_case=True)
    names = pa.array([f"{run.run_id}\n{run.name}" for run in runs], pa.string())
    try:
        found = compute.call_function("match_substring_regex", [names], options).to_pylist()
    except pa.ArrowInvalid as error:
        why = str(error).removeprefix("Invalid regular expression: ")
        st.warning(f"This is no regular expression: {text.markdown(why)}.")
        return list(runs)
    return [run for run, is_found in zip(runs, found, strict=True) if is_found]


def _scope(runs: Sequence[RunReader], by: str) -> Scope:
    found = grouped(runs, by)
    styles = styles_of([(run.env, found.kinds[run.run_id]) for run in runs], by, session.mode())
    there = {run.run_id for run in runs} | {*found.order}
    hide, show = (address.get_all(key, there.__contains__) for key in ("hide", "show"))
    hidden = found.folded.difference(show) | set(hide)
    return Scope(
        found.runs, by, found.kinds, found.titles, found.folded, hidden, address.get("run"), styles
    )


def _draw_list(scope: Scope) -> None:
    """The groups and their runs, each with an eye that shows or hides it."""
    named = {run.run_id for run in scope.runs[:LISTED]}
    called = distinct_names(scope.runs, by_user=True)
    for run in scope.cut_short:
        called[run.run_id] += f", ended at {run.status.env_step:,}: left out"

    def group(style: Style, runs: Sequence[RunReader]) -> dict[str, object]:
        items = [
            {
                "run_id": run.run_id, "name": called[run.run_id], "state": run.shown,
                "returns": _returns(run), "hidden": run.run_id in scope.hidden,
                "chosen": run.run_id == scope.chosen_id,
            }
            for run in sorted(runs, key=lambda run: (run.env, run.seed))
            if run.run_id in named
        ]  # fmt: skip
        left = sum(run.run_id not in scope.hidden for run in runs)
        return {
            "title": style.title, "colour": style.colour, "core": style.core, "runs": items,
            "count": len(runs), "left": left,
            "hidden": style.title in scope.hidden, "folded": style.title in scope.folded,
        }  # fmt: skip

    styles = {style.title: style for style in scope.styles.values()}
    sections = []
    for title, example in (("Your runs", False), ("Examples", True)):
        of_section = [run for run in scope.runs if run.small_copy == example]
        listed: dict[str, list[RunReader]] = {name: [] for name in scope.order}
        for run in of_section:
            listed[scope.title(run)].append(run)
        groups = [group(styles[name], runs) for name, runs in listed.items() if runs]
        groups.sort(key=lambda group: bool(group["folded"]))
        left = sum(run.run_id not in named for run in of_section)
        more = f"{left:,} more runs: search or filter" if left else ""
        if of_section:
            sections.append({"title": title, "groups": groups, "more": more})

    parts.draw(
        "runlist", _LIST, "runlist", {"sections": sections},
        toggled=lambda words: toggle(scope, *words), alone=lambda words: _show_alone(scope, *words),
        chosen=lambda run_ids: st.session_state.update(run=run_ids),
        everything=lambda _: _set(hide=(), show=scope.folded),
    )  # fmt: skip


def frame(runs: Sequence[RunReader]) -> None:
    """The buttons below the list, the shortcuts, the look, notices of trainings that have ended."""
    called, before = full_names(runs), st.session_state.get(ALIVE, ())
    ended = [
        {
            "title": f"{called[run.run_id]}: {run.shown}",
            "body": run.status.reason or f"last return {score(run.status.last_return)}",
        }
        for run in runs
        if not run.status.alive and run.run_id in before
    ]
    for one in ended:
        st.toast(f"**{text.markdown(one['title'])}**  \n{text.markdown(one['body'])}")
    st.session_state[ALIVE] = {run.run_id for run in runs if run.status.alive}
    mode = "" if session.links().theme else session.mode()
    parts.draw("frame", _FRAME, "page frame", {"mode": mode, "ended": ended})


def toggle(scope: Scope, word: str) -> None:
    """Show what is hidden, or hide it: a group by its title or a run by its id."""
    closed = [scope.title(run) for run in scope.runs if run.run_id == word]
    if word not in scope.hidden and scope.hidden.intersection(closed):
        word = closed[0]  # a run of a hidden group is opened with it
    hide, show = (list(st.session_state[key]) for key in ("hide", "show"))
    if word not in scope.hidden:
        _set(hide=[*hide, word], show=[other for other in show if other != word])
        return
    opened = [word] if word in scope.folded else []
    _set(hide=[other for other in hide if other != word], show=[*show, *opened])


def _show_alone(scope: Scope, word: str) -> None:
    """Show a group or a run, and no other."""
    mine = [run for run in scope.runs if word in (run.run_id, scope.title(run))]
    titles = {scope.title(run) for run in mine}
    others = [look.title for look in scope.styles.values() if look.title not in titles]
    siblings = [run.run_id for run in scope.runs if scope.title(run) in titles and run not in mine]
    _set(hide=[*others, *siblings], show=titles & scope.folded)


def _set(hide: Collection[str], show: Collection[str]) -> None:
    st.session_state["hide"], st.session_state["show"] = list(hide), sorted(show)


def _returns(run: RunReader) -> list[float]:
    _, value = curve_points(readers.metrics(run), "eval/return")
    return [float(f"{v:.3g}") for v in np.asarray(value)[spread(len(value), SPARKS)]]
