"""Findings: a card for each question, from the results of `tom reproduce`, and each whole."""

from urllib.parse import quote

import numpy as np
import pandas as pd
import streamlit as st

from app import glossary, session, text
from app.data import studies, trainings
from app.data.every_way import QUESTION, every_ways
from app.data.studies import QUESTIONS, Study
from app.data.trainings import Started
from app.data.verdicts import verdict
from app.figures.statistics import intervals, two_axes
from app.parts import address, form
from app.parts.plot import chart
from app.parts.scope import Scope
from tom.harmless import as_csv
from tom.studies.study import FOLDER as CASES

EVERY = "Every question"
SIGNS = {"Yes": ":material/check_circle:", "No": ":material/cancel:",
         "In part": ":material/contrast:", "No difference seen": ":material/help:"}  # fmt: skip
WIDE = 900
"""maximum pixels of a caption, for lines that can be read"""
SHORT = 20
"""maximum lines of a table that is shown unfolded; longer ones have single values"""
LISTED = 200
"""maximum lines of a table that are shown; the file has all"""


def page(scope: Scope) -> None:
    """A card for each question that a study answers; one study whole; how to compute the others."""
    listed = studies.listing(*studies.folders(session.links().store))
    by_name = {study.name: study for study in listed}
    if listed:
        chosen = address.choose_one(
            st.segmented_control, "Study", [EVERY, *by_name], "study", EVERY, required=True,
            label_visibility="collapsed",
        )  # fmt: skip
        if chosen == EVERY:
            _every_way(listed)
            grid = st.container(horizontal=True, key="grid")
            for study in listed:
                with grid, st.container(border=True, height="stretch"):
                    _card(study)
        else:
            _whole(by_name[chosen])
    else:
        st.info(f"No study has been computed yet: none lies in `{studies.FOLDER.absolute()}`.")
    _missing(set(by_name))


def _every_way(listed: list[Study]) -> None:
    """All ways of weighing by their distance and their model's error, where both are known."""
    for ending, found in every_ways(listed).items():
        with st.container(border=True):
            st.header(QUESTION, anchor=False)
            if ending:
                st.caption(text.markdown(f"footprint{ending}, capacity{ending}"))
            _answer(found.word, found.sentence)
            chart(
                two_axes(found.panels, 430, f"every way{ending}"), f"every way{ending}",
                "every way of weighing: distance to the policy, and its model's error",
                caption=f"{QUESTION} {found.sentence} {found.caption}",
            )  # fmt: skip
            st.caption(text.markdown(found.caption), width=WIDE)
            _against(found.against)


def _answer(word: str, sentence: str) -> None:
    st.markdown(f"### {SIGNS[word]} {word}")
    st.markdown(glossary.linked(text.markdown(sentence)))


def _against(words: str) -> None:
    if words:
        st.markdown(f"**Against it.** {glossary.linked(text.markdown(words))}")


def _card(study: Study) -> None:
    """The question, a verdict in a word and a sentence, its figure, and what speaks against it.

    A study without a rule for a verdict has the first sentence of its report; without a figure of
    the verdict, its own picture.
    """
    st.header(text.markdown(study.question or study.name), anchor=False)
    if study.question and study.name != study.verb:
        st.caption(text.markdown(study.name))
    found = verdict(study)
    if found is not None:
        _answer(found.word, found.sentence)
    elif study.findings:
        st.markdown(f"**{text.markdown(study.findings[0])}**")
    if found is not None and found.points:
        height = 110 + 22 * len(found.points)
        figure = intervals(found.points, found.axis, found.level, height, study.name)
        caption = f"{study.question} {found.sentence} Bars: 95 % intervals."
        chart(figure, f"verdict {study.name}", f"{study.question}: {found.axis}", caption=caption)
    else:
        for figure in study.figures[:1]:
            if studies.is_picture(figure):
                st.image(str(figure), alt=f"{figure.stem}: {study.question or study.name}")
    if found is not None:
        _against(found.against)
    if "command" in study.origin:
        with st.expander("The command"):
            st.code(study.origin["command"], language="bash", wrap_lines=True)
    st.button(
        "The whole study", key=f"open {study.name}",
        on_click=lambda: st.session_state.update(study=study.name),
    )  # fmt: skip


def _whole(study: Study) -> None:
    head = st.columns([5, 1], vertical_alignment="center")
    head[0].header(text.markdown(study.question or study.name), anchor=False)
    if study.report is not None:
        where = f"reports/{quote(study.name)}"
        head[1].link_button("Whole report", where, icon=":material/open_in_new:", width="stretch")
    _said(study)
    for figure in study.figures:
        with st.container(border=True):
            if studies.is_picture(figure):
                st.image(str(figure), alt=f"{figure.stem}: {study.question or study.name}")
            else:
                st.warning(f"{text.markdown(figure.name)} cannot be read.")
    for path in study.tables:
        _table(study, path.name, studies.table(path))


def _said(study: Study) -> None:
    """The paper's claim, the result, and the command."""
    left, right = st.columns([2, 3])
    if study.claim:
        with left, st.container(border=True):
            st.markdown(f"**The paper.** {text.markdown(study.claim)}")
    if study.findings:
        with right, st.container(border=True):
            lines = "".join(f"\n- {text.markdown(line)}" for line in study.findings)
            st.markdown(f"**Found here.**\n{lines}")
    if "command" in study.origin:
        with st.expander("The command that made it"):
            st.code(study.origin["command"], language="bash", wrap_lines=True)
        made = [study.origin[name] for name in ("n", "made", "machine") if name in study.origin]
        st.caption(text.markdown(" · ".join(made)))


def _table(study: Study, name: str, table: pd.DataFrame | None) -> None:
    if table is None:
        st.warning(f"{text.markdown(name)} cannot be read.")
        return
    title = f"**{text.markdown(name.removesuffix('.csv'))}**"
    if len(table) <= SHORT:
        st.markdown(title)
        _lines(study, name, table)
        return
    more = f"the first {LISTED} of {len(table):,}" if len(table) > LISTED else f"{len(table)}"
    with st.expander(f"{title}, {more} lines"):
        _lines(study, name, table)


def _lines(study: Study, name: str, table: pd.DataFrame) -> None:
    numbers = {
        column: st.column_config.NumberColumn(format="%.4g")
        for column in table.select_dtypes("floating").columns
    }
    shown = table.head(LISTED).replace(np.inf, np.nan)  # infinity: a level was never reached
    st.dataframe(shown, hide_index=True, column_config=numbers, placeholder="-")
    st.download_button(
        "CSV", as_csv(table), f"{study.name}-{name}", "text/csv",
        icon=":material/download:", on_click="ignore", key=f"download {study.name} {name}",
    )  # fmt: skip


def _missing(computed: set[str]) -> None:
    others = [name for name in QUESTIONS if name not in computed]
    if not others:
        return
    with st.expander("Studies that have not been computed here", expanded=not computed):
        if why := session.read_only_reason():
            st.caption(why)
        for name in others:
            _offer(name, may_run=not why)
        _progress()


def _offer(name: str, *, may_run: bool) -> None:
    st.markdown(QUESTIONS[name])
    words = command(name, session.links().store)
    left, right = st.columns([5, 1], vertical_alignment="center")
    left.code(form.shown(words), language="bash")
    running = name in _running() and _running()[name].process.poll() is None
    if right.button("Run", key=f"run {name}", disabled=running or not may_run, width="stretch"):
        _running()[name] = trainings.start(words)
        st.rerun()


def command(name: str, store: str) -> list[str]:
    """The arguments of `tom` that compute a study on this machine."""
    about_a_store = () if name in ("road", "tabular") else ("--store", store)
    return ["reproduce", name, *about_a_store]


def _progress() -> None:
    """The output of studies started here; the page is redrawn when one is done."""
    for name, begun in list(_running().items()):
        if begun.process.poll() is None:
            _goes_on(name, begun)
        elif any(study.name == name for study in studies.listing(studies.FOLDER)):
            # 1: computed, but a check of the acceptance failed. Another tab may have been first.
            _running().pop(name, None)
            st.rerun()
        else:
            st.error(f"{name} ended without a result:", icon=":material/error:")
            st.code(begun.tail(), language=None)


@st.fragment(run_every=2)
def _goes_on(name: str, begun: Started) -> None:
    if begun.process.poll() is not None:
        st.rerun()
    kept = len(list((studies.FOLDER / name / CASES).glob("*")))
    last = begun.tail().splitlines()[-1:] or ["started"]
    left, right = st.columns([5, 1], vertical_alignment="center")
    cases = f", {kept} cases kept" if kept else ""
    left.caption(f"**{name}** runs{cases}: {text.markdown(last[0])}")
    if right.button("Stop", key=f"stop {name}", width="stretch"):
        begun.process.terminate()  # finished cases are stored; the same button resumes


@st.cache_resource(show_spinner=False)
def _running() -> dict[str, Started]:
    """The studies started here by name, one dict for all pages of this studio."""
    return {}
