"""Findings: a card for each question, from the results of `tom reproduce`, and each whole."""

from collections.abc import Sequence
from pathlib import Path
from urllib.parse import quote

import numpy as np
import pandas as pd
import streamlit as st
from streamlit.delta_generator import DeltaGenerator

from app import session, text
from app.data import studies
from app.data.studies import Study
from app.data.verdicts import on_two_axes, verdict
from app.figures.statistics import intervals, two_axes
from app.parts import address, form, jobs
from app.parts.plot import chart
from app.parts.scope import Scope
from app.theme import learner_colour
from tom.reports.report import read_csv
from tom.studies import STUDIES, load
from tom.studies.two_axes import QUESTION
from tom.studies.verdicts import Verdict

EVERY = "Every question"
SIGNS = {"Yes": ":material/check_circle:", "No": ":material/cancel:",
         "In part": ":material/contrast:", "No difference seen": ":material/help:"}  # fmt: skip
WIDE = 900
"""maximum pixels of a caption, for lines that can be read"""
SHORT = 20
"""maximum lines of a table that is shown unfolded; longer ones have single values"""


def page(scope: Scope) -> None:
    """A card for each question that studies answer; one study whole; how to compute the others."""
    listed = studies.listing(*studies.folders(session.links().store))
    by_name = {study.name: study for study in listed}
    if listed:
        opened = address.value_of("study", lambda given: "".join(given[-1:]))
        if opened in by_name:
            asked = by_name[opened].question_key
            alike = [study.name for study in listed if study.question_key == asked]
            _whole(by_name[address.choose_part([EVERY, *alike], "study", "Study")])
        else:
            address.write("study", [])
            _cards(listed)
    else:
        st.info(f"No study has been computed yet: there is none in `{studies.FOLDER.absolute()}`.")
    others = [name for name in STUDIES if name not in by_name]
    if others:
        with st.expander("Studies not computed here", expanded=not listed):
            _offer_studies(others)


def _cards(listed: Sequence[Study]) -> None:
    """All ways of weighing on two axes, where both studies are known; then each question."""
    both = on_two_axes(listed)
    if both:
        with st.container(border=True):
            st.header(QUESTION, anchor=False)
            study = _choose_study([study for study in listed if study.name in both], "ways")
            found = both[study.name]
            label = "every way of weighing: distance to the policy, and its model's error"
            with _draw_verdict(found):
                chart(
                    two_axes(found.panels, 430, study.name), f"every way {study.name}", label,
                    caption=f"{QUESTION} {found.sentence} {found.caption}",
                )  # fmt: skip
                st.caption(text.markdown(found.caption), width=WIDE)
    grid = st.container(horizontal=True, key="grid")
    alike: dict[str, list[Study]] = {}
    for study in listed:
        alike.setdefault(study.question_key, []).append(study)
    for asked, of in alike.items():
        with grid, st.container(border=True, height="stretch"):
            head = st.container()
            _card(_choose_study(of, asked), head)


def _choose_study(candidates: Sequence[Study], key: str) -> Study:
    """The study that the user has chosen of those that answer one question."""
    if len(candidates) == 1:
        return candidates[0]
    by_name = {study.name: study for study in candidates}
    name = address.choose_one(
        st.selectbox, "Measured on", [*by_name], key, candidates[0].name,
        lambda name: by_name[name].distinction, width=400,
    )  # fmt: skip
    return by_name[name]


def _draw_verdict(found: Verdict) -> DeltaGenerator:
    """A verdict in a word and a sentence, a place for its figure, and what speaks against it."""
    st.markdown(f"### {SIGNS[found.word]} {found.word}")
    st.markdown(text.with_glossary_links(text.markdown(found.sentence)))
    place = st.container()
    if found.against:
        st.markdown(f"**Against it.** {text.with_glossary_links(text.markdown(found.against))}")
    return place


def _card(study: Study, head: DeltaGenerator) -> None:
    """The question, a verdict in a word and a sentence, its figure, and what speaks against it.

    A study without a rule for a verdict has the first sentence of its report; without a figure of
    the verdict, its own picture.
    """
    found = verdict(study)
    asked = _question(study, found)
    head.header(text.markdown(asked), anchor=False)
    if found is not None:
        place = _draw_verdict(found)
    else:
        if study.findings:
            st.markdown(f"**{text.markdown(study.findings[0])}**")
        place = st.container()
    if found is not None and found.points:
        height = 110 + 22 * len(found.points)
        colours = [learner_colour(point.learner) for point in found.points]
        figure = intervals(found.points, colours, found.axis, found.level, height, study.name)
        bars = " Bars: 95 % intervals." if np.isfinite([p.low for p in found.points]).any() else ""
        caption = f"{asked} {found.sentence}{bars}"
        with place:
            chart(figure, f"verdict {study.name}", f"{asked}: {found.axis}", caption=caption)
    elif study.figures:
        with place:
            _draw_picture(study.figures[0], asked)
    _command(study, "The command")
    st.button(
        "The whole study", key=f"open {study.name}",
        on_click=lambda: st.session_state.update(study=study.name),
    )  # fmt: skip


def _question(study: Study, found: Verdict | None) -> str:
    """What a study asks; its name if nobody knows."""
    return (found and found.question) or study.question or study.name


def _draw_picture(figure: Path, asked: str) -> None:
    try:
        st.image(str(figure), alt=f"{figure.stem}: {asked}")
    except (OSError, ValueError, SyntaxError):  # of Pillow
        st.warning(f"{text.markdown(figure.name)} cannot be read.")


def _whole(study: Study) -> None:
    """The paper's claim, the result, the command, and all figures and tables."""
    head = st.columns([5, 1], vertical_alignment="center")
    asked = _question(study, verdict(study))
    head[0].header(text.markdown(asked), anchor=False)
    if study.report is not None:
        where = f"reports/{quote(study.name)}"
        head[1].link_button("Whole report", where, icon=":material/open_in_new:", width="stretch")
    if study.claim:
        st.markdown(f"**The paper.** {text.markdown(study.claim)}", width=WIDE)
    if study.findings:
        lines = "".join(f"\n- {text.markdown(line)}" for line in study.findings)
        st.markdown(f"**Found here.**\n{lines}", width=WIDE)
    _command(study, "The command that made it")
    if "command" in study.origin:
        made = [study.origin[name] for name in ("n", "made", "machine") if name in study.origin]
        st.caption(text.markdown(" · ".join(made)))
    for figure in study.figures:
        with st.container(border=True):
            _draw_picture(figure, asked)
    for path in study.tables:
        table = read_csv(path)
        if table is None:
            st.warning(f"{text.markdown(path.name)} cannot be read.")
            continue
        title = f"**{text.markdown(path.stem)}**"
        folded = len(table) > SHORT
        with st.expander(f"{title}, {len(table):,} lines") if folded else st.container():
            if not folded:
                st.markdown(title)
            _draw_table(path.stem, table)


def _command(study: Study, title: str) -> None:
    if "command" in study.origin:
        with st.expander(title):
            st.code(study.origin["command"], language="bash", wrap_lines=True)


def _draw_table(name: str, table: pd.DataFrame) -> None:
    numbers = {
        column: st.column_config.NumberColumn(format="%.4g")
        for column in table.select_dtypes("floating").columns
    }
    shown = table.replace(np.inf, np.nan)  # infinity: a level was never reached
    st.dataframe(shown, hide_index=True, column_config=numbers, placeholder="-", alt=name)


def _offer_studies(names: Sequence[str]) -> None:
    """The commands of studies, and buttons that run them."""
    if why := session.read_only_reason():
        st.caption(why)
    for name in names:
        st.markdown(load(name).QUESTION)
        about = () if name in ("road", "tabular") else ("--store", session.links().store)
        words = ["reproduce", name, *about]
        left, right = st.columns([5, 1], vertical_alignment="center")
        left.code(form.command_line(words), language="bash")
        disabled = jobs.is_running(name) or bool(why)
        if right.button("Run", key=f"run {name}", disabled=disabled, width="stretch"):
            jobs.start(name, words)
            st.rerun()
    for name in names:
        jobs.show(name)
