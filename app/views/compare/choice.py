"""Which runs are compared: filters, and single runs that are hidden or pinned."""

import re
from collections.abc import Mapping, Sequence

import streamlit as st

from app import text
from app.data.readers import RunInfo
from app.theme import learner_label

FIELDS = {
    "env": ("Environment", str),
    "learner": ("Learner", learner_label),
    "preset": ("Preset", str),
}


def chosen(runs: Sequence[RunInfo]) -> list[RunInfo]:
    """The runs that pass the filters and are not hidden, and those that are pinned."""
    with st.container(border=True):
        row = st.columns(5)
        kept: list[RunInfo] = list(runs)
        for column, (field, (label, shown)) in zip(row, FIELDS.items(), strict=False):
            options = sorted({getattr(run, field) for run in runs})
            picked = column.multiselect(
                label,
                options,
                key=field,
                bind="query-params",
                placeholder="all",
                format_func=shown,
                filter_mode="contains",
                select_all=False,
            )
            kept = [run for run in kept if not picked or getattr(run, field) in picked]
        tags = row[3].multiselect(
            "Tag",
            sorted({tag for run in runs for tag in run.labels.tags}),
            key="tag",
            bind="query-params",
            placeholder="any",
            filter_mode="contains",
            select_all=False,
        )
        words = row[4].text_input(
            "Name",
            key="text",
            bind="query-params",
            placeholder="regular expression",
            help="part of a run's name or id; a regular expression, such as `tom-s[01]`",
        )
        kept = matching([run for run in kept if tagged(run, tags)], words or "")
        return _by_hand(runs, kept)


def tagged(run: RunInfo, tags: Sequence[str]) -> bool:
    """The run has one of the tags; any run where none is asked for."""
    return not tags or bool(set(tags) & set(run.labels.tags))


def matching(runs: Sequence[RunInfo], words: str) -> list[RunInfo]:
    """The runs whose name or id the regular expression finds; all, and why, if it is malformed."""
    try:
        pattern = re.compile(words, re.IGNORECASE)
    except re.error as error:
        st.warning(f"This is no regular expression: {text.markdown(error)}.")
        return list(runs)
    return [run for run in runs if pattern.search(run.run_id) or pattern.search(run.name)]


def _by_hand(runs: Sequence[RunInfo], kept: Sequence[RunInfo]) -> list[RunInfo]:
    names = called(runs)
    with st.expander("Hide or pin single runs"):
        left, right = st.columns(2)
        pinned = right.multiselect(
            "Pinned: shown whatever the filters say",
            list(names),
            key="pin",
            bind="query-params",
            format_func=lambda run_id: names.get(run_id, run_id),
            placeholder="none",
            filter_mode="contains",
            select_all=False,
        )
        hidden = left.multiselect(
            "Hidden",
            [run.run_id for run in kept],
            key="hide",
            bind="query-params",
            format_func=lambda run_id: names.get(run_id, run_id),
            placeholder="none",
            filter_mode="contains",
            select_all=False,
        )
    ids = {run.run_id for run in kept} - set(hidden) | set(pinned)
    return [run for run in runs if run.run_id in ids]


def called(runs: Sequence[RunInfo]) -> Mapping[str, str]:
    """What to call each run in a list, by its id."""
    return {
        run.run_id: f"{run.labels.name} ({run.run_id})" if run.labels.name else run.run_id
        for run in runs
    }
