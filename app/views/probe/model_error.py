"""Whether weighting helps: the errors of learners' models on one buffer and on their own."""

from collections import Counter
from collections.abc import Sequence

import streamlit as st

from app.data import buffer_reader, readers
from app.data.readers import RunInfo
from app.figures.probe import errors_by_age, focus
from app.parts import empty
from app.parts.plot import chart
from app.theme import learner_label
from tom.analysis.curves import curve_points

MODELS = 8
"""maximum number of stored models to test on one buffer: the newest of each learner in turn"""
BINS = 20
PAIRS = {
    "One step": ("model/error_policy", "model/error_other"),
    "Five steps in a row": ("model/rollout_error_policy", "model/rollout_error_other"),
}


def on_one_buffer(run: RunInfo, others: Sequence[RunInfo]) -> None:
    """The errors on the buffer of `run` of its own stored model and of other runs' models."""
    errors = []
    for other in in_turn(run, others):
        error = buffer_reader.errors_on(run, other)
        if error is not None:
            own = " (its own)" if other.run_id == run.run_id else ""
            errors.append(
                (f"{learner_label(other.learner)} s{other.seed}{own}", other.learner, error)
            )
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
        chart(errors_by_age(errors, BINS, 320), "errors here", "model error against age")


def in_turn(run: RunInfo, others: Sequence[RunInfo]) -> list[RunInfo]:
    """The run itself, then the first run of each learner, then their second runs, and so on."""
    seen: Counter[str] = Counter()
    turns = []
    for other in others:
        turns.append((other.run_id != run.run_id, seen[other.learner]))
        seen[other.learner] += 1
    order = sorted(range(len(others)), key=lambda i: turns[i])
    return [others[i] for i in order]


def recorded(runs: Sequence[RunInfo]) -> None:
    """The errors that the runs have recorded at their last fits."""
    columns = st.columns(2)
    for column, (words, (policy, other)) in zip(columns, PAIRS.items(), strict=True):
        values = focus_values(runs, policy, other)
        with column, st.container(border=True):
            st.markdown(
                f"**{words}**: full, the policy's newest transitions; hollow, the rest",
                help="at each run's last fit, on its own buffer: rows the model was just fitted to",
            )
            if values:
                chart(focus(values, 280, policy), f"focus {words}", "model error by learner")
            else:
                st.caption("No run of this task has measured it.")
    st.caption(
        "Above, each run is on its own buffer, which differs from run to run. The same buffer for "
        "every learner, with models fitted afresh and transitions that the policy makes anew: "
        "`tom reproduce focus`."
    )


def focus_values(
    runs: Sequence[RunInfo], policy: str, other: str
) -> dict[str, list[tuple[str, float, float]]]:
    """(run, error on the policy's transitions, on the others) at the last fit, by learner."""
    by_learner: dict[str, list[tuple[str, float, float]]] = {}
    for run in sorted(runs, key=lambda run: (run.learner, run.seed, run.run_id)):
        frame = readers.metrics(run)
        pair = [curve_points(frame, metric)[1] for metric in (policy, other)]
        if all(len(values) for values in pair):
            by_learner.setdefault(run.learner, []).append(
                (run.run_id, float(pair[0][-1]), float(pair[1][-1]))
            )
    return by_learner
