"""Compare: learners against each other, over seeds, in figures and numbers to download."""

from collections.abc import Callable, Sequence

import streamlit as st

from app import session, text
from app.data import readers, tables
from app.parts import address, shortlinks, widgets
from app.views.compare import curves, labels, numbers, side
from app.views.compare.choice import chosen_runs
from app.views.compare.comparison import Comparison, compare
from tom.analysis.settings import NONE, USUAL, choices
from tom.record.reader import RunReader

CURVES = "Curves"
MOST_COLUMNS = 24
GROUP_WIDTH = 230
SECTIONS: dict[str, Callable[[Comparison], None]] = {
    "Statistics": numbers.draw,
    "Side by side": side.draw,
}
SETTINGS, RUNS = "Settings", "Runs"


def page() -> None:
    """One row of controls; below it curves, statistics, runs side by side, settings or labels."""
    listing = readers.listing(session.links().store)
    row = st.container(horizontal=True, vertical_alignment="center", gap="small")
    section = address.choose_one(
        row.segmented_control, "Show", [CURVES, *SECTIONS, SETTINGS, RUNS], "show", CURVES,
        required=True, label_visibility="collapsed",
    )  # fmt: skip
    row.space("stretch")
    with row.popover("Runs", icon=":material/filter_alt:"):
        runs = chosen_runs(listing.runs)
    by = address.choose_one(
        row.selectbox, "Group by", choices(runs), "group", USUAL,
        lambda path: f"by {path}", label_visibility="collapsed", width=GROUP_WIDTH,
    )  # fmt: skip
    comparison = compare(runs, by)
    if not runs:
        st.info("No run passes these filters.", icon=":material/filter_alt_off:")
    elif section == RUNS:
        labels.draw(runs, listing.runs)
    elif not comparison.shown and section != CURVES:
        st.info("Every run is hidden: under Curves their eyes open again.")
    elif section == SETTINGS:
        _settings(comparison.shown)
    elif section == CURVES:
        curves.draw(comparison, row)
    else:
        SECTIONS[section](comparison)
    address.write()  # before the end, because Link reads it
    with row:
        shortlinks.button()
    for run in runs:
        # Without the problems of weights: reading the profiles of every run takes seconds.
        widgets.show_problems(run, readers.metrics_problems(run))
    widgets.show_store_problems(listing.problems)


def _settings(runs: Sequence[RunReader]) -> None:
    """The settings that differ, one column per run."""
    shown = runs[:MOST_COLUMNS]
    table = tables.settings(shown, [run.name for run in shown])
    if table.empty:
        st.info("These runs have the same settings." if len(runs) > 1 else "One run alone.")
        return
    words = f"The newest {MOST_COLUMNS} of {len(runs)} runs. " if len(runs) > len(shown) else ""
    st.caption(
        f"{words}Settings that are the same everywhere are left out; "
        f"{text.markdown(NONE)}: the run's version did not have it."
    )
    st.dataframe(table, hide_index=True)
    curves.downloads({"Settings": (lambda: table, "settings")}, "compare")
