"""Why this weight? A transition, the terms of its weight, its neighbours, its rollouts."""

import numpy as np
import pandas as pd
import streamlit as st

from app import session, text
from app.data import buffer_map, trainings
from app.data import why as reasons
from app.data.buffer import Rows
from app.data.buffer_map import Source
from app.data.why import Why
from app.figures.why import rollout_lines, waterfall
from app.parts.plot import chart
from app.theme import learner_label
from app.views.attention import progress
from tom.analysis.why import Sum
from tom.config import TomConfig
from tom.envs import ROAD, is_code
from tom.learners import SUBJECT
from tom.readable import number, percent, score, short
from tom.record.reader import RunReader

KEY = "row"
STARTED = "why weighing"
"""the process that this section started, in the session"""
HEIGHT = 290
FORMULA = {
    "chi2": "max(0, 1 + sum)",
    "full-chi2": "max(0, 1 + sum / 2)",
    "kl": "exp(sum)",
}
FLOWS = {
    "discounted": "discounted, as printed in the paper",
    "restart": "restart: an end is followed by a new start",
    "stationary": "stationary: g = 1, an end is followed by a new start, the mean weight is 1",
}


def pick(row: int) -> None:
    """Choose the transition with this number in the run's record."""
    st.session_state[KEY] = row


def asked(rows: Rows) -> int | None:
    """The chosen row of the buffer, before its widget is drawn; None if there is none."""
    held = st.session_state.get(KEY, st.query_params.get(KEY, ""))
    row = None if held is None else text.whole(held)
    last = rows.first + len(rows) - 1
    return None if row is None or not rows.first <= row <= last else row - rows.first


def section(run: RunReader, rows: Rows, source: Source) -> None:
    """Choose a transition, and explain its weight."""
    with st.container(border=True):
        row = _pick(rows)
        if row is None:
            return
        found = reasons.why_of(run, rows, source)
        _head(rows, row)
        if isinstance(found, str):
            st.info(f"No sum: {text.markdown(found)}.", icon=":material/functions:")
            _offer(run, rows)
        else:
            left, right = st.columns([3, 2])
            with left:
                st.markdown("**The sum**")
                summed = found.sum_of(row)
                figure = waterfall(summed, SUBJECT, HEIGHT)
                chart(figure, "why sum", "the terms that make the weight")
                st.caption(in_words(found.config, summed, found.whose))
            with right:
                _neighbours(run, rows, found, row)
        if run.env != ROAD:
            _rollouts(run, rows, row)


def _pick(rows: Rows) -> int | None:
    """The chosen row of the buffer: by a click, a widget or the address (`?row=`)."""
    last = rows.first + len(rows) - 1
    held = st.session_state.get(KEY, st.query_params.get(KEY, ""))
    asked = None if held is None else text.whole(held)
    # Streamlit's own reading of the address fails at "inf".
    bind = None if text.whole(st.query_params.get(KEY, 0)) is None else "query-params"
    if held is not None and (asked is None or not rows.first <= asked <= last):
        st.session_state.pop(KEY, None)
        st.query_params.pop(KEY, None)
    columns = st.columns([5, 4, 3, 3, 2, 3], vertical_alignment="bottom", gap="small")
    columns[0].markdown("**Why this weight?** Click a transition on a map, or choose one")
    order, weight = np.argsort(rows.weight, kind="stable"), rows.weight
    zero, above = np.flatnonzero(weight == 0), np.flatnonzero(weight > 0)
    suggested = {
        "heaviest": order[-1],
        "average": above[np.abs(weight[above] - 1).argmin()] if len(above) else None,
        "zero": zero[len(zero) // 2] if len(zero) else None,
        "newest": len(rows) - 1,
    }
    for column, (name, row) in zip(columns[2:], suggested.items(), strict=False):
        if column.button(name, key=f"why {name}", disabled=row is None, width="stretch"):
            st.session_state[KEY] = rows.first + int(row or 0)
    chosen = columns[1].number_input(
        "Number of the transition", rows.first, last, value=None, key=KEY, bind=bind,
        placeholder="none yet",
        help="its row in the run's record, counted from 0: one less than its step",
    )  # fmt: skip
    return None if chosen is None else int(chosen) - rows.first


def _head(rows: Rows, row: int) -> None:
    columns = st.columns(5)
    lighter = float((rows.weight < rows.weight[row]).mean())
    columns[0].metric("weight", number(float(rows.weight[row]), 3))
    columns[1].metric("heavier than", percent(lighter), help="of the buffer")
    columns[2].metric("its step in its episode", f"{rows.place[row] + 1:,}")
    columns[3].metric("return of that episode", score(float(rows.episode_return[row])))
    ends = "yes" if rows.rows.numpy().ended()[row] else "no"
    columns[4].metric("ends the episode", ends)


def in_words(config: TomConfig, parts: Sum, whose: str) -> str:
    """The weight as a formula with its numbers."""
    divided = (
        f" / {short(parts.mean)} (its mean over the buffer)" if config.divergence != "kl" else ""
    )
    g = 1.0 if config.flow == "stationary" else config.discount
    cut = " The sum lies below the cut, so the weight is zero." if parts.raw == 0 else ""
    formula = FORMULA[config.divergence].replace("sum", short(parts.argument))
    return text.markdown(
        f"{short(parts.weight)} = {formula}{divided}.{cut} Divergence {config.divergence}, flow "
        f"{FLOWS[config.flow]}; g = {g:g}. Terms of {whose}."
    )


def _neighbours(run: RunReader, rows: Rows, found: Why, row: int) -> None:
    near = reasons.neighbours(rows, found, row)
    st.markdown("**Its nearest of the policy's own transitions**")
    names, actions = buffer_map.named(run)
    obs, action = np.asarray(near.rows.obs), np.asarray(near.rows.action)
    own = np.concatenate([np.asarray(rows.rows.obs)[row], np.asarray(rows.rows.action)[row]])
    table = pd.DataFrame({"": [*names, *actions], "this one": own})
    for i, distance in enumerate(near.near.distance.tolist()):
        # Several may lie equally far, to two places.
        table[f"{i + 1}: at {distance:.2f}"] = np.concatenate([obs[i], action[i]])
    numbers = {c: st.column_config.NumberColumn(c, format="%.2f") for c in table.columns[1:]}
    st.dataframe(table, hide_index=True, height=240, column_config=numbers)
    first = float(near.near.distance[0])
    st.caption(
        f"Distances in standard deviations over (s, a, s' - s). To its nearest of the policy's "
        f"{len(found.policy_rows):,} transitions this one has {first:.2f}; half of the buffer's "
        f"other rows have less than {near.usual:.2f}, half of the policy's own, to the rest of "
        f"them, less than {near.own:.2f}."
    )


def _rollouts(run: RunReader, rows: Rows, row: int) -> None:
    st.markdown("**The rollouts that start there**")
    begun = reasons.starts(run, rows, row)
    step = rows.first + len(rows)
    if not isinstance(begun, str):
        here, usual = begun
        st.caption(
            f"Of each round's rollouts about {here:,.2f} start in this state; {usual:,.2f} would "
            "at weight 1."
            if here > 0
            else "No rollout starts in this state."
        )
    rollouts = reasons.rollouts(run, rows, row, step)
    if isinstance(rollouts, str):
        st.caption(f"No rollouts: {text.markdown(rollouts)}.")
        return
    paths = rollouts.paths
    names, _ = buffer_map.named(run)
    moved = paths[:, 1].std(0) / np.maximum(np.asarray(rows.rows.obs).std(0), 1e-9)
    first = int(np.nan_to_num(moved).argmax())
    name = st.selectbox("Dimension", names, index=first, key="why dimension")
    i = names.index(name or names[first])
    recorded = reasons.recorded_after(rows, row)[:, i]
    figure = rollout_lines(paths[:, :, i], recorded, names[i], run.learner, HEIGHT)
    chart(figure, "why rollouts", "rollouts of the policy in the model from this state")
    by = "" if rollouts.own else ", by the run's last policy: that of this fit was not kept"
    st.caption(
        f"{len(paths)} rollouts in the model of step {rollouts.model_step:,}, the last that the "
        f"run kept{by}."
    )


def _offer(run: RunReader, rows: Rows) -> None:
    """Offer to weigh the buffer of this step again, with its terms.

    Not where that would run code of the user's, which a page never starts.
    """
    step = rows.first + len(rows)
    if run.env == ROAD or is_code(run.env) or step not in run.policy_steps():
        return
    store = session.links().store
    words = ["weigh", run.argument, "--policy", run.argument, "--step", str(step)]
    words += ["--learner", SUBJECT, "--seeds", "0", "--store", store]
    st.caption(
        "Weighed anew with this fit's policy and the run's settings the buffer has terms (Q begins "
        "afresh there, so weights differ from the run's own). Then choose them in the buffer, "
        "under Weights of."
    )
    if why := session.read_only_reason():
        st.caption(why)
    elif st.button(f"Weigh this buffer by {learner_label(SUBJECT)}", key="why weigh"):
        st.session_state[STARTED] = trainings.start(words)
    progress.show(STARTED)
