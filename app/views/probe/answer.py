"""The answer on top of the page: which group of runs errs least on its own policy's transitions.

It also says whether the difference is more than noise. It is out of sample if runs have exams; else
it uses the errors on the policy's newest transitions, to which the models were fitted.
"""

from collections.abc import Mapping, Sequence

import numpy as np
import streamlit as st

from app import text
from app.data.buffer import Floats
from app.figures.probe import RunErrors
from app.views.probe import exams, model_error
from tom.analysis.statistics import RANKED, means_differ
from tom.readable import percent, short
from tom.record.reader import RunReader


def draw(runs: Sequence[RunReader]) -> None:
    """The answer in a sentence."""
    _, result = exams.examined(runs)
    if len(result.standings) > 1:
        st.markdown(exams.verdict(result), help=exams.WHAT)
    else:
        policy, other = model_error.PAIRS["One step"]
        errors = in_sample(model_error.focus_values(runs, policy, other))
        st.markdown(f"{sentence(errors)} In sample: on transitions that the models were fitted to.")


def in_sample(groups: Mapping[str, Sequence[RunErrors]]) -> dict[str, Floats]:
    """Each group's errors (n,) on the policy's newest transitions."""
    return {name: np.array([run.policy for run in runs]) for name, runs in groups.items()}


def sentence(errors: Mapping[str, Floats]) -> str:
    """Who errs least, by how much, n, and if beyond noise; `errors` are (n,) by name."""
    finite = {name: values[np.isfinite(values)] for name, values in errors.items()}
    found = sorted((e for e in finite.items() if len(e[1])), key=lambda e: float(e[1].mean()))
    if not found:
        return "**Who errs least where its policy goes?** No run of this task has measured it."
    if len(found) == 1:
        (name, values) = found[0]
        return (
            f"**{text.markdown(name)} alone has measured its error where its policy goes**: "
            f"{short(values.mean())}."
        )
    ranked = [(name, values) for name, values in found if len(values) >= RANKED]
    if len(ranked) < 2:
        means = (f"{text.markdown(name)} {short(v.mean())} (n = {len(v)})" for name, v in found)
        said = f"**Too few seeds to rank** ({exams.NEEDED}). Where the policy goes"
        return f"{said}: {'; '.join(means)}."
    (first, least), (second, more), *_ = ranked
    less = 1 - float(least.mean() / more.mean()) if more.mean() else 0.0
    return (
        f"**Where its own policy goes, {text.markdown(first)} errs least**: "
        f"{short(least.mean())}, {percent(less, 0)} less than {text.markdown(second)}, "
        f"the next (n = {len(least)} and {len(more)}). {beyond_noise(least, more)}"
    )


def beyond_noise(least: Floats, more: Floats) -> str:
    """A sentence on whether the gap of two means is larger than chance explains."""
    gap = float(more.mean() - least.mean())
    error = float(np.sqrt(least.var(ddof=1) / len(least) + more.var(ddof=1) / len(more)))
    said = "More than noise" if means_differ(least, more) else "No more than noise"
    return f"{said}: the gap is {short(gap, 2)}, its standard error {short(error, 2)}."
