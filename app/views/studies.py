"""Studies: what `tom reproduce` found, with the figures, the tables and the whole report."""

from urllib.parse import quote

import numpy as np
import pandas as pd
import streamlit as st

from app import text
from app.data import studies
from app.data.studies import QUESTIONS, Study
from tom.harmless import as_csv

TITLE = "Studies"
ICON = ":material/lab_profile:"
PATH = "studies"

SHORT = 20
"""lines of a table that is seen at once; longer ones, of single values, are folded away"""
LISTED = 200
"""lines of a table that are shown; the file holds all"""


def page() -> None:
    """One study of those that were computed; what the others are and how to compute them."""
    found = studies.found()
    if found:
        by_name = {study.name: study for study in found}
        chosen = st.segmented_control(
            "Study", list(by_name), default=found[0].name, required=True, key="study",
            bind="query-params",
        )  # fmt: skip
        _shown(by_name.get(chosen or "", found[0]))
    else:
        st.info(f"No study has been computed yet: none lies in `{studies.FOLDER.absolute()}`.")
    _missing({study.name for study in found})


def _shown(study: Study) -> None:
    head = st.columns([5, 1], vertical_alignment="center")
    head[0].markdown(f"**{text.markdown(study.question or study.name)}**")
    if study.report is not None:
        address = f"/reports/{quote(study.name)}"
        head[1].link_button("Whole report", address, icon=":material/open_in_new:", width="stretch")
    for figure in study.figures:
        with st.container(border=True):
            if studies.is_picture(figure):
                st.image(str(figure))
            else:
                st.warning(f"{text.markdown(figure.name)} cannot be read.")
    for path in study.tables:
        _table(study, path.name, studies.table(path))


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
    shown = table.head(LISTED).replace(np.inf, np.nan)  # a level that was never reached
    st.dataframe(shown, hide_index=True, column_config=numbers, placeholder="-")
    st.download_button(
        "CSV", as_csv(table), f"{study.name}-{name}", "text/csv",
        icon=":material/download:", on_click="ignore", key=f"download {study.name} {name}",
    )  # fmt: skip


def _missing(computed: set[str]) -> None:
    others = {name: words for name, words in QUESTIONS.items() if name not in computed}
    if not others:
        return
    with st.expander("Studies that have not been computed here", expanded=not computed):
        for name, words in others.items():
            st.markdown(words)
            st.code(f"tom reproduce {name}", language="bash")
