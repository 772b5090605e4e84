"""Whether weighting helps: the errors of learners' models on one buffer and on their own."""

from collections import Counter
from collections.abc import Sequence

import streamlit as st

from app.data import buffer, readers
from app.figures.probe import RunErrors, errors_by_age, focus
from app.parts import empty
from app.parts.plot import chart
from app.views.answer.exams import group_names, show_left_out
from tom.analysis.curves import curve_points
from tom.analysis.imagine import stored_step
from tom.record.reader import RunReader

MODELS = 8
"""maximum number of stored models to test on one buffer: the newest of each group in turn"""
BINS = 20
PAIRS = {
    "One step": ("model/error_policy", "model/error_other"),
    "Five steps in a row": ("model/rollout_error_policy", "model/rollout_error_other"),
}


def on_one_buffer(run: RunReader, others: Sequence[RunReader]) -> None:
    """The errors on the buffer of `run` of its own stored model and of other runs' models."""
    kept = [other for other in others if stored_step(other) is not None]
    errors, beyond, names = [], list(kept), group_names(kept)
    for other in in_turn(run, kept):
        error = buffer.errors_on(run, other)
        if error is not None:
            own = " (its own)" if other.run_id == run.run_id else ""
            errors.append((f"{names[other.run_id]} s{other.seed}{own}", other.learner, error))
            beyond.remove(other)
        if len(errors) == MODELS:
            break
    if not errors:
        if not empty.left_out_of_all(others, "model"):
            st.caption("No run of this task has kept a model whose errors could be shown.")
        return
    with st.container(border=True):
        st.markdown(
            "**Error of the kept models along this buffer**: one step, mean of each twentieth",
            help="root mean square over the dimensions, each in standard deviations of its change "
            "in a step over this buffer. A model has seen its own buffer alone.",
        )
        figure = errors_by_age(errors, BINS, 320, keep=run.run_id)
        chart(figure, "errors here", "model error against age")
        without = [other for other in others if other not in kept]
        show_left_out(
            others, {"no kept model": without, f"beyond {MODELS} models, or unreadable": beyond}
        )


def in_turn(run: RunReader, others: Sequence[RunReader]) -> list[RunReader]:
    """The run itself, then the first run of each group, then their second runs, and so on."""
    seen, names = Counter[str](), group_names(others)
    turns = []
    for other in others:
        turns.append((other.run_id != run.run_id, seen[names[other.run_id]]))
        seen[names[other.run_id]] += 1
    order = sorted(range(len(others)), key=lambda i: turns[i])
    return [others[i] for i in order]


def recorded(runs: Sequence[RunReader]) -> None:
    """The errors that the runs have recorded at their last fits of like step."""
    columns = st.columns(2)
    for column, (words, (policy, other)) in zip(columns, PAIRS.items(), strict=True):
        groups = focus_values(runs, policy, other)
        with column, st.container(border=True):
            st.markdown(
                f"**{words}**: full, the policy's newest transitions; hollow, the rest",
                help="at each run's last fit up to the step that every run reaches, on its own "
                "buffer: rows the model was just fitted to",
            )
            if groups:
                chart(focus(groups, 280, policy), f"focus {words}", "model error by group")
                drawn = {one.run_id for of in groups.values() for one in of}
                without = [run for run in runs if run.run_id not in drawn]
                show_left_out(runs, {"not measured": without})
            else:
                st.caption("No run of this task has measured it.")
    st.caption(
        "Above, each run is on its own buffer, which differs from run to run. The same buffer for "
        "every learner, with models fitted afresh and transitions that the policy makes anew: "
        "`tom reproduce focus`."
    )


def focus_values(runs: Sequence[RunReader], policy: str, other: str) -> dict[str, list[RunErrors]]:
    """The errors of each run, by the name of its group: `policy` and `other`.

    Those of its last fit up to the step that every run reaches: errors fall as data come.
    """
    groups, names = dict[str, list[RunErrors]](), group_names(runs)
    measured = []
    for run in sorted(runs, key=lambda run: (run.learner, names[run.run_id], run.seed, run.run_id)):
        frame = readers.metrics(run)
        pair = [curve_points(frame, metric) for metric in (policy, other)]
        if all(len(step) for step, _ in pair):
            measured.append((run, pair))
    until = min((step[-1] for _, pair in measured for step, _ in pair), default=0)
    for run, pair in measured:
        values = [value[step <= until] for step, value in pair]
        if all(len(value) for value in values):
            errors = RunErrors(run.run_id, run.learner, *(float(value[-1]) for value in values))
            groups.setdefault(names[run.run_id], []).append(errors)
    return groups
