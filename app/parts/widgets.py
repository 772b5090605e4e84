"""Small widgets that several pages use."""

from collections.abc import Callable, Mapping, Sequence

import pandas as pd
import streamlit as st

from app import text
from app.data import readers
from tom.analysis.curves import Curve, curve_points
from tom.harmless import as_csv
from tom.learners import LEARNERS, SUBJECT
from tom.record.reader import RunReader

Files = Mapping[str, tuple[Callable[[], pd.DataFrame], str]]
"""tables by their label: how each is made, and the end of its file's name"""


def curve(run: RunReader, metric: str) -> Curve:
    """One metric of a run against env steps."""
    step, value = curve_points(readers.metrics(run), metric)
    return Curve(run.run_id, run.env, run.learner, run.preset, run.seed, step, value)


def telling(run: RunReader) -> tuple[object, ...]:
    """A sort key: runs with uneven weights first, then one's own before examples, then the rank of
    their learner, the longest and the most complete."""
    return (
        not differs(run), run.small_copy, run.learner != SUBJECT, run.preset != "mended",
        -run.status.env_step, len(run.left_out),
    )  # fmt: skip


def differs(run: RunReader) -> bool:
    """Whether the weights of the run's last fit are not uniform."""
    if run.learner in LEARNERS and LEARNERS[run.learner].uniform:
        return False  # known without reading
    profiles = readers.profiles(readers.weighed(run))
    return len(profiles.ess) > 0 and bool(profiles.ess[-1] < 0.99)


def show_problems(run: RunReader, problems: Sequence[str] | None = None) -> None:
    """Show the problems of a run."""
    for problem in readers.problems(run) if problems is None else problems:
        st.warning(
            f"{text.markdown(run.run_id)}: {text.markdown(problem)}", icon=":material/heart_broken:"
        )


def show_store_problems(problems: Sequence[str]) -> None:
    """Show the folders of the store that are not runs, folded."""
    if problems:
        with st.expander(f"{len(problems)} in this store could not be read as a run"):
            for problem in problems:
                st.text(problem)


def link_to(path: str, label: str, **choices: str) -> None:
    """A link to another page of this studio, with what all pages share and further choices."""
    pages = st.session_state.get("pages", {})
    if path in pages:  # else this page is drawn alone
        st.page_link(
            pages[path], label=label, icon=":material/arrow_forward:", query_params=choices or None
        )


def downloads(files: Files, name: str) -> None:
    """A download button for each table; its CSV file is made when the user asks for it."""
    with st.container(horizontal=True):
        for label, (make, suffix) in files.items():
            st.download_button(
                label,
                lambda make=make: as_csv(make()),
                f"{name.replace('/', '-')}-{suffix}.csv",
                "text/csv",
                icon=":material/download:",
                on_click="ignore",
                key=f"download {label}",
            )
