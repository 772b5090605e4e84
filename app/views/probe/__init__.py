"""Probe: every learner's weights of one buffer, and whether weighting helps the model."""

from collections.abc import Mapping
from functools import partial

import numpy as np
import pandas as pd
import streamlit as st

from app import session, text
from app.data import buffer, readers, weighings
from app.data.weighings import Dataset, Weighing
from app.figures.probe import probe_profiles
from app.parts import empty, widgets
from app.parts.plot import chart
from app.parts.weighing import show_notices
from app.theme import learner_label
from app.views.probe import answer, exams, left_out, model_error, start
from app.views.probe.length import of_like_length
from tom.config import SAC_ALONE
from tom.envs import ROAD

COLUMNS = {
    "ESS": "ess",
    "weight 0": "zeros",
    "random": "random_mean",
    "newest": "last_two",
    "trend": "spearman",
}
"""columns of the table, and their names in the report of a weighing"""


def page() -> None:
    """A buffer, the learners' weights of its rows, and the errors of their models."""
    listing = readers.listing(session.links().store)
    online = [run for run in listing.runs if run.env != ROAD]
    kept = [run for run in online if buffer.has_rows(run)]
    buffers = [*kept, *weighings.datasets(session.links().store)]
    if not buffers:
        if not empty.left_out_of_all(online, "buffer"):
            st.info("No run of a MuJoCo task has collected transitions yet.")
        start.draw_own()
        return
    top = st.columns([1, 1], vertical_alignment="bottom")
    with top[0]:
        names = weighings.weighed(session.links().store)
        weighed = [run for run in buffers if isinstance(run, Dataset) or run.run_id in names]
        run = widgets.pick_run(buffers, "Buffer of run or data", weighed)
    rows = buffer.length(run)
    if not rows:
        st.warning("This replay buffer cannot be read.")
        return
    of_buffer = weighings.of_run(run, rows)
    with top[1]:
        chosen = _pick_weighing(of_buffer)
    task = [other for other in online if other.env == run.env]
    alone = [other for other in task if other.learner == SAC_ALONE]
    alike, others = of_like_length([other for other in task if other not in alone])
    answer.draw(alike)
    lengths = dict.fromkeys(other.status.env_step for other in others)
    of_length = {
        f"of another length ({steps:,} steps)": [o for o in others if o.status.env_step == steps]
        for steps in lengths
    }
    left_out.show(task, {**of_length, "it fits no model": alone})
    st.subheader("Several learners on the same buffer", anchor=False)
    if chosen is None:
        st.info("Nobody has weighed this buffer yet: start it below.", icon=":material/scale:")
    else:
        _weighed(chosen, rows)
    if isinstance(run, Dataset):
        start.draw_again(run)
    else:
        start.draw(run, kept, folded=chosen is not None)
    start.draw_own()
    st.subheader("Does it help?", anchor=False)
    exams.draw(alike)
    st.subheader("In sample: on rows that the models were fitted to", anchor=False)
    model_error.on_one_buffer(run, alike)
    model_error.recorded(alike)
    widgets.show_problems(run)


def _pick_weighing(of_buffer: list[Weighing]) -> Weighing | None:
    by_name = {weighing.name: weighing for weighing in of_buffer}
    if not of_buffer:
        st.selectbox("Weighed", ["not yet"], disabled=True)
        return None
    chosen = st.selectbox(
        "Weighed", list(by_name), key="weighed", bind="query-params",
        help="results of `tom weigh` in the store, newest first",
    )  # fmt: skip
    return by_name.get(chosen or "", of_buffer[0])


def _weighed(weighing: Weighing, rows: int) -> None:
    of = weighing.weights()
    if not of:
        st.warning("The weights of this weighing cannot be read.")
        return
    if missing := weighing.missing(rows):
        st.caption(missing)
    show_notices(weighing)
    count = len(next(iter(of.values())))
    left, right = st.columns([5, 4])
    with left, st.container(border=True):
        head = st.container(horizontal=True, vertical_alignment="center")
        head.markdown(
            f"**By the policy of {text.markdown(weighing.policy)}**: the dotted line ends the "
            "random data"
        )
        profiles = weighings.profiles(of)
        log = widgets.pick_log(head, list(profiles.values()))
        share = weighing.ordered_from / count
        figure = probe_profiles(profiles, share, 400, log=log, keep=weighing.name)
        chart(figure, "probe", "weight profiles of several learners on the same buffer")
    with right, st.container(border=True):
        st.markdown("**What the weights come to**: medians over seeds")
        st.dataframe(
            table(weighing.medians, weighing.footprints),
            hide_index=True, height="content", column_config=_columns(),
        )  # fmt: skip
        st.caption(f"TOM with {text.markdown(weighing.settings)}. Weights have mean 1.")


def table(
    medians: Mapping[str, Mapping[str, float]], footprints: Mapping[str, tuple[float, float]]
) -> pd.DataFrame:
    """One row per learner: medians over its seeds."""

    def footprint(learner: str) -> dict[str, str]:
        if not footprints:
            return {}
        value, error = footprints.get(learner, (np.nan, np.nan))
        spread = f" ± {error:.2f}" if np.isfinite(error) else ""
        return {"footprint": f"{value:.2f}{spread}" if np.isfinite(value) else "-"}

    return pd.DataFrame(
        {
            "learner": learner_label(learner),
            **footprint(learner),
            **{column: found.get(name, np.nan) for column, name in COLUMNS.items()},
        }
        for learner, found in medians.items()
    )


def _columns() -> dict:
    number = partial(st.column_config.NumberColumn, width=68)
    return {
        "footprint": st.column_config.TextColumn(
            width=96,
            help="distance of the weighted buffer to fresh episodes of the policy over that of the "
            "unweighted buffer, ± its standard error over those episodes (if there are five or "
            "more): 1 is no better than no weights, 0 like the policy itself",
        ),
        "ESS": number(format="percent", help="effective sample (sum w)² / sum w², of the buffer"),
        "weight 0": number(format="percent", help="share of transitions with weight zero"),
        "random": number(format="%.3g", help="mean weight of the random data"),
        "newest": number(format="%.3g", help="mean weight of the newest tenth of the buffer"),
        "trend": number(
            format="%.3g",
            help="rank correlation of the tenths of the ordered part with their order: 1 when "
            "newer counts more throughout",
        ),
    }
