"""Every learner's weights of one buffer, side by side, and how to weigh one."""

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd
import streamlit as st

from app import session, text
from app.data import buffer, weighings
from app.data.buffer import Floats
from app.data.run_names import full_names
from app.data.weighings import Dataset, Weighing
from app.figures.weights import median_profiles
from app.parts import address, form, jobs, widgets
from app.parts.plot import chart
from app.parts.scope import Scope
from app.views.attention import in_buffer
from tom.analysis.weighing import POLICIES, PRESETS, RANDOM
from tom.data.card import sentence
from tom.data.datasets import FORMATS
from tom.envs import ANY, ENVS, ROAD, is_code
from tom.learners import LEARNERS, WEIGHED_FIRST, follows_behaviour, learner_label
from tom.readable import percent
from tom.record.reader import RunReader

END = "the end"
FOREIGN = "policy.pt, policy.onnx or module:function"
FOOTPRINT = st.column_config.TextColumn(
    width=96,
    help="distance of the weighted buffer to fresh episodes of the policy, divided by the "
    "unweighted buffer's, ± its standard error over those episodes (if there are five or more). "
    "1: no nearer than without weights, 0: the policy itself",
)
COLUMNS = {
    "ESS": ("ess", "percent", "effective sample (sum w)² / sum w², as a share of the buffer"),
    "weight 0": ("zeros", "percent", "share of transitions with weight zero"),
    "random": ("random_mean", "%.2f", "mean weight of the random data"),
    "newest": ("last_two", "%.2f", "mean weight of the newest tenth of the buffer"),
    "trend": (
        "spearman", "%.2f",
        "rank correlation of the tenths of the ordered part with their order: 1 when newer counts "
        "more throughout",
    ),
}  # fmt: skip
"""columns of the table: the name in the report of a weighing, format, and meaning"""


def draw(scope: Scope) -> None:
    """A buffer and the learners' weights of its rows; how to weigh it."""
    store = session.links().store
    online = [run for run in scope.runs if run.env != ROAD]
    kept = [run for run in online if buffer.has_rows(run)]
    weighed = weighings.weighed_run_ids(store)
    top, (left, right) = st.container(), st.columns([1, 1], vertical_alignment="bottom")
    run = in_buffer.choose(
        scope, lambda: right, kept.__contains__,
        lambda run: (run.run_id not in weighed, *widgets.interest_key(run)),
    )  # fmt: skip
    rows = 0 if run is None else buffer.length(run)
    if run is not None:
        name = text.markdown(full_names(scope.runs).get(run.run_id, run.name))
        top.header(f"How each learner weighs the buffer of {name}", anchor=False)
    if run is None:
        if not widgets.show_left_out_of_all(online, "buffer"):
            st.info("No run of a MuJoCo task has collected transitions here yet.")
    elif not rows:
        st.warning("This replay buffer cannot be read.")
        return
    else:
        found = {one.name: one for one in weighings.all_of_run(run)}
        if found:
            shown = weighings.titles([*found.values()])
            chosen = address.choose_one(
                left.selectbox, "Weighed", list(found), "weighed", next(iter(found)),
                shown.__getitem__,
                help="live weights of a loop of your own; results of `tom weigh`, newest first",
            )  # fmt: skip
            _draw_weighing(found[chosen], rows)
        else:
            left.selectbox("Weighed", ["not yet"], disabled=True)
            st.info("Nobody has weighed this buffer yet: start it below.", icon=":material/scale:")
        if isinstance(run, Dataset):  # pages do not look for the user's files
            with st.expander("Weigh this data", icon=":material/scale:"):
                st.caption("No run collected this data. Weigh it in a terminal, from where it is:")
                st.code(
                    form.command_line(run.weigh_arguments(store)), language="bash", wrap_lines=True
                )
                st.caption("It was last weighed by:")
                st.code(run.command, language="bash", wrap_lines=True)
        else:
            _weigh_form(run, kept, expanded=not found)
    with st.expander("Data and policies of your own", icon=":material/upload_file:"):
        words = ["weigh", "DATA", "--policy", "POLICY", "--env", "ENV", "--store", store]
        st.code(form.command_line(words), language="bash")
        st.caption(f"DATA: a run (id or folder), {FORMATS}, oldest transition first.")
        st.caption(f"POLICY: {POLICIES}.")
        st.caption(f"ENV: {', '.join(ENVS)}, {ANY}. A run and its policy know theirs.")
    if run is not None:
        widgets.show_problems(run)


def _draw_weighing(weighing: Weighing, rows: int) -> None:
    of = weighing.weights()
    if not of:
        st.warning("The weights of this weighing cannot be read.")
        return
    in_buffer.show_remarks(weighing, rows, sentence(weighing.report.get("card", {})))
    footprints = weighing.footprints
    if closest := nearest({name: of[:, 0] for name, of in footprints.items()}):
        st.markdown(text.unbroken(closest))
    with st.container(border=True):
        share = weighing.ordered_from / len(next(iter(of.values())))
        ends = ": the dotted line ends the random data" if share > 0 else ""
        st.markdown(f"**By {text.markdown(weighing.policy)}**{ends}")
        figure = median_profiles(weighings.profiles(of), share, 400, keep=weighing.name)
        chart(figure, "probe", "weight profiles of several learners on the same buffer")
    with st.container(border=True):
        st.markdown("**The weights in numbers**: medians over seeds")
        shown = {
            name: st.column_config.NumberColumn(width=68, format=number, help=words)
            for name, (_, number, words) in COLUMNS.items()
        }
        st.dataframe(
            _table(weighing.report["medians"], footprints), hide_index=True, width="content",
            height="content", column_config={"footprint": FOOTPRINT, **shown}, alt="The learners",
        )  # fmt: skip
        st.caption(f"TOM with {text.markdown(weighing.settings)}. Weights have mean 1.")


def nearest(footprints: Mapping[str, Floats]) -> str:
    """Which learner's weights lie nearest to the policy, by how much, and whether seeds of one
    learner differ less; empty for fewer than two learners. `footprints` are (seeds,)."""
    finite = {name: of[np.isfinite(of)] for name, of in footprints.items()}
    found = sorted((float(np.median(v)), n) for n, v in finite.items() if len(v))
    if len(found) < 2:
        return ""
    (least, first), (more, second) = found[:2]
    one, other = (text.markdown(learner_label(name)) for name in (first, second))
    apart = max((float(np.ptp(of)) for of in finite.values() if len(of) > 1), default=None)
    if apart is None:
        sure = "With one seed each, that may be chance"
    else:
        sure = (
            f"That is {'more' if more - least > apart else 'no more'} than two seeds of one "
            f"learner differ here (at most {percent(apart, 0)})"
        )
    return (
        f"**{one} puts its weight nearest to the policy**: its weighted buffer keeps "
        f"{percent(least, 0)} of the distance to fresh episodes of the policy; {other} comes next "
        f"with {percent(more, 0)}. {sure}."
    )


def _table(
    medians: Mapping[str, Mapping[str, float]], footprints: Mapping[str, Floats]
) -> pd.DataFrame:

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
            **{
                column: float(np.array(found.get(name), np.float64))
                for column, (name, *_) in COLUMNS.items()
            },
        }
        for learner, found in medians.items()
    )


def _weigh_form(run: RunReader, kept: Sequence[RunReader], *, expanded: bool) -> None:
    """A form that starts `tom weigh` on this buffer, all of it or its state at a fit."""
    with st.expander("Weigh this buffer", icon=":material/scale:", expanded=expanded):
        row = st.columns([2, 4, 4, 2, 2])
        widgets.show_left_out(run, "policies")
        steps = run.policy_steps() if run.fits_model else []
        at = address.choose_one(
            row[0].selectbox, "As it was at step", [END, *steps], "at", END,
            lambda step: str(step) if step == END else f"{step:,}",
            help="the buffer and the policies at that fit; the steps are those where both were "
            "kept",
        )  # fmt: skip
        step = None if at == END else int(at)
        policies = [one.run_id for one in kept if one.env == run.env and one.has_policy(step)]
        policies.sort(key=lambda name: name != run.run_id)
        offered = [*policies, RANDOM, FOREIGN]
        address.follow_default("weigh policy", offered[0])
        policy = row[1].selectbox("By the policy of", offered, key="weigh policy")
        usable = [name for name in LEARNERS if run.keeps_behaviour() or not follows_behaviour(name)]
        with row[2]:
            learners = address.multiselect(
                "Learners", usable, list(WEIGHED_FIRST), key="weigh learners",
                format_func=learner_label,
            )  # fmt: skip
        preset = row[3].selectbox(
            "TOM's preset", PRESETS, key="weigh preset",
            help="own: the settings of the buffer's run",
        )  # fmt: skip
        seeds = int(row[4].number_input("Seeds", 1, 10, 2, key="weigh seeds"))
        foreign = policy == FOREIGN
        if foreign:  # in the form that `tom weigh` accepts
            policy = st.text_input("File or function", placeholder=FOREIGN, key="weigh foreign")
        words = [
            "weigh", run.run_id, "--policy", policy or "POLICY",
            *(["--env", run.env] if is_code(run.env) else []),
            *([] if step is None else ["--step", str(step)]),
            "--learner", *learners, "--seeds", *map(str, range(seeds)), "--preset", preset,
            "--store", session.links().store,
        ]  # fmt: skip
        st.code(form.command_line(words), language="bash", wrap_lines=True)
        job = f"Weighing {run.run_id}"
        if why := session.read_only_reason():
            st.caption(why)
        elif foreign or is_code(run.env):
            st.caption("This runs code of yours, so start it in a terminal.")
        elif st.button(
            "Weigh", type="primary", disabled=not learners or jobs.is_running(job), key="weigh"
        ):
            jobs.start(job, words)
        if len(usable) < len(LEARNERS):
            lacking = ", ".join(learner_label(name) for name in LEARNERS if name not in usable)
            st.caption(f"{lacking}: this run does not say which policies drew its actions.")
        if run.run_id not in policies and not widgets.show_left_out(run, "policy"):
            st.caption("This run has no policy of its own yet: it is written when the run ends.")
    jobs.show(job)
