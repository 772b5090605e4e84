"""Compare: learners against each other, over seeds, in figures and numbers that can be taken."""

from collections.abc import Callable, Sequence

import streamlit as st

from app import session, text
from app.data import readers, settings
from app.data.readers import RunInfo
from app.parts import shortlinks, widgets
from app.views.compare import curves, labels, numbers, side
from app.views.compare.choice import chosen

TITLE = "Compare"
ICON = ":material/stacked_line_chart:"
PATH = "compare"

CURVES = "Curves"
MOST_COLUMNS = 24
SECTIONS: dict[str, Callable[[Sequence[RunInfo]], None]] = {
    CURVES: curves.draw,
    "Statistics": numbers.draw,
    "Side by side": side.draw,
}
SETTINGS, RUNS = "Settings", "Runs"


def page() -> None:
    """Filters; then one of: curves, statistics, runs side by side, settings, labels."""
    listing = readers.listing(session.links().store)
    runs = chosen(listing.runs)
    left, right = st.columns([5, 1], vertical_alignment="center")
    section = left.segmented_control(
        "Show",
        [*SECTIONS, SETTINGS, RUNS],
        default=CURVES,
        required=True,
        key="show",
        bind="query-params",
        label_visibility="collapsed",
    )
    with right:
        shortlinks.button()
    if not runs:
        st.info("No run passes these filters.", icon=":material/filter_alt_off:")
    elif section == SETTINGS:
        _settings(runs)
    elif section != RUNS:
        SECTIONS[section or CURVES](runs)
    if section == RUNS:
        labels.draw(runs, listing.runs)
    for run in runs:
        # Not those of the weights: to read every run's profiles takes seconds.
        widgets.show_problems(run, readers.metrics_problems(run))
    widgets.show_store_problems(listing.problems)


def _settings(runs: Sequence[RunInfo]) -> None:
    """Only what differs, a column a run."""
    shown = runs[:MOST_COLUMNS]
    table = settings.table(shown, [run.name for run in shown])
    if table.empty:
        st.info("These runs have the same settings." if len(runs) > 1 else "One run alone.")
        return
    words = f"The newest {MOST_COLUMNS} of {len(runs)} runs. " if len(runs) > len(shown) else ""
    st.caption(
        f"{words}Settings that are the same everywhere are left out; "
        f"{text.markdown(settings.NONE)}: the run's version did not have it."
    )
    st.dataframe(table, hide_index=True)
    curves.downloads({"Settings": (lambda: table, "settings")}, "compare")
