"""The choice of the runs to compare: filters, and single runs that are pinned."""

from collections.abc import Mapping, Sequence

import pyarrow as pa
import pyarrow.compute as compute
import streamlit as st

from app import text
from app.parts import address
from app.theme import learner_label
from tom.record.reader import RunReader

FIELDS = {
    "env": ("Environment", str),
    "learner": ("Learner", learner_label),
    "preset": ("Preset", str),
}


def chosen_runs(runs: Sequence[RunReader]) -> list[RunReader]:
    """The runs that pass the filters, and those that are pinned."""
    kept: list[RunReader] = list(runs)
    for field, (label, shown) in FIELDS.items():
        options = sorted({getattr(run, field) for run in runs})
        picked = address.choose_many(label, options, field, shown, placeholder="all")
        kept = [run for run in kept if not picked or getattr(run, field) in picked]
    every = sorted({tag for run in runs for tag in run.labels.tags})
    tags = address.choose_many("Tag", every, "tag", placeholder="any")
    words = address.text_input(
        "Name", "text", placeholder="regular expression",
        help="part of a run's name or id; a regular expression, such as `tom-s[01]`",
    )  # fmt: skip
    kept = matching([run for run in kept if tagged(run, tags)], words)
    names = names_with_ids(runs)
    pinned = address.choose_many(
        "Pinned: compared whatever the filters say", list(names), "pin", names.__getitem__,
        placeholder="none",
    )  # fmt: skip
    ids = {run.run_id for run in kept} | set(pinned)
    return [run for run in runs if run.run_id in ids]


def tagged(run: RunReader, tags: Sequence[str]) -> bool:
    """Whether the run has one of the tags; always true if `tags` is empty."""
    return not tags or bool(set(tags) & set(run.labels.tags))


def matching(runs: Sequence[RunReader], words: str) -> list[RunReader]:
    """The runs whose name or id contains a match of the regular expression `words`.

    If it is malformed, all runs are returned and the page says why. The expression may come from a
    link, so it is matched in time linear in the names, unlike by Python's `re`.
    """
    try:
        by_id, by_name = (
            _matches(words, names)
            for names in ([run.run_id for run in runs], [run.name for run in runs])
        )
    except pa.ArrowInvalid as error:
        why = str(error).removeprefix("Invalid regular expression: ")
        st.warning(f"This is no regular expression: {text.markdown(why)}.")
        return list(runs)
    return [run for run, *found in zip(runs, by_id, by_name, strict=True) if any(found)]


def _matches(words: str, names: Sequence[str]) -> list[bool]:
    options = compute.MatchSubstringOptions(words, ignore_case=True)
    arguments = [pa.array(names, pa.string())]
    return compute.call_function("match_substring_regex", arguments, options).to_pylist()


def names_with_ids(runs: Sequence[RunReader]) -> Mapping[str, str]:
    """By run id: the user's name with the id in brackets, or the id alone."""
    return {
        run.run_id: f"{run.labels.name} ({run.run_id})" if run.labels.name else run.run_id
        for run in runs
    }
