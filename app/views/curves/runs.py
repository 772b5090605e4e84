"""The runs as tables: names, tags and notes, the trash, and the settings that differ."""

from collections.abc import Callable, Sequence

import numpy as np
import pandas as pd
import streamlit as st

from app import session, text
from app.data import readers, tables
from app.data.run_names import distinct_names
from app.parts import address
from app.parts.scope import Scope, toggle
from tom.analysis.settings import NONE, differences
from tom.errors import UserError
from tom.learners import learner_label
from tom.record import manage
from tom.record.manage import NAME_LENGTH, NOTE_LENGTH
from tom.record.reader import RunReader
from tom.record.store import Store

OWN_COLUMNS = ("env", "learner", "preset", "seed", "steps")
"""settings that have columns of their own"""
MOST_SETTINGS, MOST_COLUMNS = 12, 24
MARK = "font-weight: 650; background-color: rgba(200, 68, 28, 0.2)"
COLUMNS = {
    "shown": st.column_config.CheckboxColumn("shown", help="as its eye at the left"),
    "tags": st.column_config.ListColumn("tags"),
    "steps": st.column_config.NumberColumn("steps", format="localized"),
    "last": st.column_config.NumberColumn("last return", format="%.4g"),
    "best": st.column_config.NumberColumn("best return", format="%.4g"),
}


def draw(scope: Scope) -> None:
    """A table of the runs that pass the filters, with their eyes; below it actions on them."""
    runs = scope.runs
    table = overview(runs)
    shown = [scope.hidden.isdisjoint((run.run_id, scope.title(run))) for run in runs]
    table.insert(0, "shown", np.array(shown, bool))
    apart = {path: of for path, of in differences(runs).items() if path not in OWN_COLUMNS}
    for path, of in reversed([*apart.items()][:MOST_SETTINGS]):
        table.insert(4, path, of)  # after the name and the tags
    edited = st.data_editor(
        table, hide_index=True, column_config=COLUMNS, alt="The runs",
        key=f"runs {sorted(scope.hidden)}", disabled=[name for name in table if name != "shown"],
    )  # fmt: skip
    for run, on, was in zip(runs, edited["shown"], table["shown"], strict=True):
        if on != was:
            toggle(scope, run.run_id)
            st.rerun()
    if why := session.read_only_reason():
        st.caption(why)
        return
    # By their ids: a choice would be lost whenever a new name changed its words.
    picked = address.multiselect(
        "Runs to label or to move to the trash", [run.run_id for run in runs], key="labelled",
        placeholder="none",
    )  # fmt: skip
    store = Store(session.links().store)
    if chosen := [run for run in runs if run.run_id in picked]:
        left, right = st.columns([3, 2])
        with left, st.container(border=True):
            _label(store, chosen)
        with right, st.container(border=True):
            st.markdown("**Trash**: nothing is deleted; runs come back from below")
            one = len(chosen) == 1
            words = "Move it to the trash" if one else f"Move {len(chosen)} runs to the trash"
            with st.popover(words, icon=":material/delete:"):
                sure = st.button("Yes, move it" if one else "Yes, move them", key="trash")
            if sure:
                _act(lambda: manage.trash(store, *picked), "Moved to the trash")
    if there := readers.trashed(store.path):
        with st.expander(f"{len(there)} in the trash"):
            back = address.multiselect(
                "Runs to bring back", there, key="restored", placeholder="none"
            )
            if st.button("Bring back", icon=":material/restore_from_trash:", disabled=not back):
                _act(lambda: manage.restore(store, *back), "Brought back")


def overview(runs: Sequence[RunReader]) -> pd.DataFrame:
    return pd.DataFrame(
        {
            "run": run.run_id,
            "name": run.labels.name,
            "tags": list(run.labels.tags),
            "environment": run.env,
            "learner": learner_label(run.learner),
            "seed": run.seed,
            "preset": run.preset,
            "state": run.shown,
            "steps": run.status.env_step,
            "last": run.status.last_return,
            "best": run.status.best_return,
            "created": run.created[:16].replace("T", " "),
            "note": run.labels.note,
        }
        for run in runs
    )


def _label(store: Store, chosen: Sequence[RunReader]) -> None:
    one = chosen[0] if len(chosen) == 1 else None
    key = " ".join(run.run_id for run in chosen)
    name = note = None
    with st.form(f"label {key}", border=False):
        if one:
            name = st.text_input(
                "Name", one.labels.name, max_chars=NAME_LENGTH, placeholder=one.run_id
            )
            note = st.text_area("Note", one.labels.note, max_chars=NOTE_LENGTH)
        all_tags = list(dict.fromkeys(tag for run in chosen for tag in run.labels.tags))
        shared = [tag for tag in all_tags if all(tag in run.labels.tags for run in chosen)]
        tags = address.multiselect(
            "Tags" if one else f"Tags of these {len(chosen)} runs", all_tags, shared,
            accept_new_options=True, placeholder="type a tag and press Enter",
            help=None if one else "the tags that all of them have; each run keeps its other tags",
        )  # fmt: skip
        saved = st.form_submit_button("Save", icon=":material/save:", type="primary")

    def save() -> None:
        for run in chosen:
            added = [tag for tag in tags if tag not in shared]
            removed = [tag for tag in shared if tag not in tags]
            manage.label(store, run.run_id, name=name, note=note, add=added, remove=removed)

    if saved:
        _act(save, "Saved")


def _act(action: Callable[[], object], done: str) -> None:
    """Call `act` and draw the page again; if it fails, show why in one line."""
    try:
        action()
    except (UserError, OSError) as error:
        st.error(text.markdown(error), icon=":material/error:")
        return
    st.toast(done, icon=":material/check:")
    st.rerun()


def settings(shown: Sequence[RunReader]) -> None:
    """The settings that differ, one column per run; those unlike the first run's are marked."""
    some = shown[:MOST_COLUMNS]
    table = tables.settings(some, distinct_names(some, by_user=True).values())
    if table.empty:
        st.info("These runs have the same settings." if len(shown) > 1 else "One run alone.")
        return
    words = f"The newest {MOST_COLUMNS} of {len(shown)} runs. " if len(shown) > len(some) else ""
    st.caption(
        f"{words}Settings that are the same everywhere are left out; values unlike the first run's "
        f"are marked; {text.markdown(NONE)}: the run's version lacked it."
    )

    def marked(row: pd.Series) -> list[str]:
        first = row.iloc[1]
        return ["" if i < 2 or value == first else MARK for i, value in enumerate(row)]

    st.dataframe(table.style.apply(marked, axis=1), hide_index=True, alt="Settings")
