"""Every learner's weights of one buffer, side by side."""

from collections.abc import Mapping
from functools import partial

import numpy as np
import pandas as pd
import streamlit as st

from app import session, text
from app.data import buffer, weighings
from app.data.buffer import Floats
from app.data.weighings import Dataset, Weighing
from app.figures.probe import probe_profiles
from app.parts import address, empty, widgets
from app.parts.plot import chart
from app.parts.scope import Scope
from app.theme import learner_label
from app.views.attention import weigh
from app.views.attention.in_buffer import pick_data
from app.views.attention.progress import show_notices
from tom import readable
from tom.envs import ROAD

COLUMNS = {
    "ESS": "ess",
    "weight 0": "zeros",
    "random": "random_mean",
    "newest": "last_two",
    "trend": "spearman",
}
"""columns of the table, and their names in the report of a weighing"""


def draw(scope: Scope) -> None:
    """A buffer and the learners' weights of its rows; how to weigh it."""
    store = session.links().store
    data = {one.run_id: one for one in weighings.datasets(store)}
    online = [run for run in scope.runs if run.env != ROAD]
    kept = [run for run in online if buffer.has_rows(run)]
    weighed = weighings.weighed(store)
    run = data.get(scope.asked) or scope.one(
        lambda run: run in kept, lambda run: (run.run_id not in weighed, *widgets.telling(run))
    )
    top = st.columns([1, 1], vertical_alignment="bottom")
    if data:
        run = pick_data(top[1], data, run)
    if run is None:
        if not empty.left_out_of_all(online, "buffer"):
            st.info("No run of a MuJoCo task has collected transitions here yet.")
        weigh.draw_own()
        return
    rows = buffer.length(run)
    if not rows:
        st.warning("This replay buffer cannot be read.")
        return
    with top[0]:
        chosen = _pick_weighing(weighings.every(run, rows))
    if chosen is None:
        st.info("Nobody has weighed this buffer yet: start it below.", icon=":material/scale:")
    else:
        _weighed(chosen, rows)
    if isinstance(run, Dataset):
        weigh.draw_again(run)
    else:
        weigh.draw(run, kept, folded=chosen is not None)
    weigh.draw_own()
    widgets.show_problems(run)


def _pick_weighing(of_buffer: list[Weighing]) -> Weighing | None:
    by_name = {weighing.name: weighing for weighing in of_buffer}
    if not of_buffer:
        st.selectbox("Weighed", ["not yet"], disabled=True)
        return None
    chosen = address.choose_one(
        st.selectbox, "Weighed", list(by_name), "weighed", of_buffer[0].name,
        help="live weights of a loop of your own; results of `tom weigh`, newest first",
    )  # fmt: skip
    return by_name[chosen]


def _weighed(weighing: Weighing, rows: int) -> None:
    of = weighing.weights()
    if not of:
        st.warning("The weights of this weighing cannot be read.")
        return
    if missing := weighing.missing(rows):
        st.caption(missing)
    if weighing.card:
        st.caption(weighing.card)
    show_notices(weighing)
    count = len(next(iter(of.values())))
    footprints = weighing.footprints
    if sentence := nearest({name: of[:, 0] for name, of in footprints.items()}):
        st.markdown(sentence)
    with st.container(border=True):
        st.markdown(
            f"**By the policy of {text.markdown(weighing.policy)}**: the dotted line ends the "
            "random data"
        )
        share = weighing.ordered_from / count
        figure = probe_profiles(weighings.profiles(of), share, 400, keep=weighing.name)
        chart(figure, "probe", "weight profiles of several learners on the same buffer")
    with st.container(border=True):
        st.markdown("**What the weights come to**: medians over seeds")
        st.dataframe(
            table(weighing.medians, footprints),
            hide_index=True, width="content", height="content", column_config=_columns(),
        )  # fmt: skip
        st.caption(f"TOM with {text.markdown(weighing.settings)}. Weights have mean 1.")


def nearest(footprints: Mapping[str, Floats]) -> str:
    """Which learner's weights lie nearest to the policy, by how much, and whether that is more
    than seeds of one learner differ, which one seed cannot tell; empty for fewer than two learners.
    `footprints` are (seeds,)."""
    finite = {name: of[np.isfinite(of)] for name, of in footprints.items()}
    found = sorted((float(np.median(v)), n) for n, v in finite.items() if len(v))
    if len(found) < 2:
        return ""
    (least, first), (more, second) = found[:2]
    one, other = (text.markdown(learner_label(name)) for name in (first, second))
    apart = max((float(np.ptp(of)) for of in finite.values() if len(of) > 1), default=None)
    if apart is None:
        sure = "One seed each cannot tell whether that is chance"
    else:
        sure = (
            f"That is {'more' if more - least > apart else 'no more'} than two seeds of one "
            f"learner differ here (at most {readable.percent(apart, 0)})"
        )
    return (
        f"**{one} puts its weight nearest to the policy**: its weighted buffer keeps "
        f"{readable.percent(least, 0)} of the distance to the policy's fresh episodes, {other}'s, "
        f"the next, {readable.percent(more, 0)}. {sure}."
    )


def table(
    medians: Mapping[str, Mapping[str, float]], footprints: Mapping[str, Floats]
) -> pd.DataFrame:
    """One row per learner: medians over its seeds."""

    def footprint(learner: str) -> dict[str, str]:
        if not footprints:
            return {}
        value, error = np.median(footprints.get(learner, [[np.nan, np.nan]]), 0)
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
