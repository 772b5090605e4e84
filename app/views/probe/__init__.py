"""Probe: every learner's weights of one buffer, and whether weighting helps the model."""

from functools import partial

import numpy as np
import pandas as pd
import streamlit as st
from streamlit.delta_generator import DeltaGenerator

from app import session, text
from app.data import buffer_reader, datasets, pictures, readers, trainings, weighings
from app.data.readers import RunInfo
from app.data.trainings import Started
from app.data.weighings import WeighingInfo
from app.figures.probe import probe_profiles
from app.parts import empty, form, widgets
from app.parts.plot import chart
from app.theme import learner_label
from app.views.probe import answer, exams, model_error
from app.views.probe.length import of_like_length
from tom.analysis.progression import Progression
from tom.analysis.weighing import POLICIES, RANDOM
from tom.analysis.weighing_plan import PRESETS
from tom.data.datasets import FORMATS
from tom.envs import ANY, ENVS, is_code
from tom.learners import LEARNERS, WEIGHED_FIRST

TITLE = "Probe"
ICON = ":material/experiment:"
PATH = "probe"

END = "the end"
FOREIGN = "policy.pt, policy.onnx or module:function"
DIGITS = 6  # decimals in the table, because PMAC's weights of old data are 1e-20


def page() -> None:
    """A buffer, the learners' weights of its rows, and the errors of their models."""
    listing = readers.listing(session.links().store)
    online = [run for run in listing.runs if run.env != pictures.ENV]
    kept = [run for run in online if buffer_reader.has_rows(run)]
    buffers = [*kept, *datasets.listing(session.links().store)]
    if not buffers:
        if not empty.left_out_of_all(online, "buffer"):
            st.info("No run of a MuJoCo task has collected transitions yet.")
        _own()
        return
    top = st.columns([1, 1], vertical_alignment="bottom")
    with top[0]:
        weighed = [run for run in buffers if weighings.of_run(run, buffer_reader.length(run))]
        run = widgets.pick_run(buffers, "Buffer of run or data", weighed)
    rows = buffer_reader.length(run)
    if not rows:
        st.warning("This replay buffer cannot be read.")
        return
    of_buffer = weighings.of_run(run, rows)
    with top[1]:
        chosen = _pick_weighing(of_buffer)
    task = [other for other in online if other.env == run.env]
    alike, others = of_like_length(task)
    answer.draw(alike, others)
    st.subheader("Several learners on the same buffer", anchor=False)
    if chosen is None:
        st.info("Nobody has weighed this buffer yet: start it below.", icon=":material/scale:")
    else:
        _weighed(chosen, rows)
    if datasets.is_one(run):
        _weigh_again(run)
    else:
        _weigh(run, kept, folded=chosen is not None)
    _own()
    st.subheader("Does it help?", anchor=False)
    exams.draw(alike)
    st.subheader("In sample: on rows that the models were fitted to", anchor=False)
    same = [other for other in alike if buffer_reader.has_rows(other)]
    model_error.on_one_buffer(run, same)
    model_error.recorded(same)
    widgets.show_problems(run)


def _pick_weighing(of_buffer: list[WeighingInfo]) -> WeighingInfo | None:
    by_name = {weighing.name: weighing for weighing in of_buffer}
    if not of_buffer:
        st.selectbox("Weighed", ["not yet"], disabled=True)
        return None
    chosen = st.selectbox(
        "Weighed", list(by_name), key="weighed", bind="query-params",
        help="results of `tom weigh` in the store, newest first",
    )  # fmt: skip
    return by_name.get(chosen or "", of_buffer[0])


def _weighed(weighing: WeighingInfo, rows: int) -> None:
    of = weighings.weights(weighing)
    if not of:
        st.warning("The weights of this weighing cannot be read.")
        return
    if missing := weighing.missing(rows):
        st.caption(missing)
    count = len(next(iter(of.values())))
    left, right = st.columns([5, 4])
    with left, st.container(border=True):
        head = st.columns([3, 1], vertical_alignment="center")
        head[0].markdown(
            f"**By the policy of {text.markdown(weighing.policy)}**: the dotted line ends the "
            "random data"
        )
        profiles = weighings.profiles(of)
        log = widgets.pick_log(head[1], list(profiles.values()))
        figure = probe_profiles(profiles, weighing.ordered_from / count, 400, log=log)
        chart(figure, "probe", "weight profiles of several learners on the same buffer")
    with right, st.container(border=True):
        st.markdown("**What the weights come to**: medians over seeds")
        st.dataframe(
            table(weighings.numbers(weighing, of), weighings.footprints(weighing)),
            hide_index=True, height="content", column_config=_columns(),
        )  # fmt: skip
        st.caption(f"TOM with {text.markdown(weighing.settings)}. Weights have mean 1.")


def table(
    by_learner: dict[str, list[Progression]], footprints: dict[str, tuple[float, float]]
) -> pd.DataFrame:
    """One row per learner: medians over its seeds."""

    def median(rows: list[Progression], name: str) -> float:
        values = [getattr(row, name) for row in rows]
        return float("nan") if None in values else round(float(np.median(values)), DIGITS)

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
            "ESS": median(rows, "ess"),
            "zero": median(rows, "zeros"),
            "random": median(rows, "random_mean"),
            "newest": median(rows, "last_two"),
            "rank": median(rows, "spearman"),
        }
        for learner, rows in by_learner.items()
    )


def _columns() -> dict:
    number = partial(st.column_config.NumberColumn, width=68)
    return {
        "footprint": st.column_config.TextColumn(
            width=96,
            help="distance of the weighted buffer to fresh episodes of the policy over that of the "
            "unweighted buffer, ± its standard error: 1 is no better than no weights, 0 like "
            "the policy itself",
        ),
        "ESS": number(format="percent", help="effective sample (sum w)² / sum w², of the buffer"),
        "zero": number(format="percent", help="share of transitions with weight zero"),
        "random": number(format="%.3g", help="mean weight of the random data"),
        "newest": number(format="%.3g", help="mean weight of the newest tenth of the buffer"),
        "rank": number(
            format="%.3g",
            help="rank correlation of the tenths of the ordered part with their order: 1 when "
            "newer counts more throughout",
        ),
    }


def _weigh_again(run: RunInfo) -> None:
    """Show the command that weighs a data set, because pages do not look for the user's files."""
    with st.expander("Weigh this data", icon=":material/scale:"):
        st.caption("No run collected it, so it is weighed in a terminal, where it lies by now:")
        words = datasets.words(run, session.links().store)
        st.code(form.shown(words), language="bash", wrap_lines=True)
        st.caption("It was last weighed by:")
        st.code(datasets.command(run), language="bash", wrap_lines=True)


def _own() -> None:
    """Show the command that weighs data and policies of other libraries."""
    with st.expander("Data and policies of your own", icon=":material/upload_file:"):
        words = ["weigh", "DATA", "--policy", "POLICY", "--env", "ENV"]
        st.code(form.shown([*words, "--store", session.links().store]), language="bash")
        st.caption(f"DATA: a run (id or folder), {FORMATS}, oldest transition first.")
        st.caption(f"POLICY: {POLICIES}.")
        st.caption(f"ENV: {', '.join(ENVS)}, {ANY}. A run and its policy know theirs.")


def _weigh(run: RunInfo, kept: list[RunInfo], *, folded: bool) -> None:
    """A form that starts `tom weigh` on this buffer, all of it or its state at a fit."""
    with st.expander("Weigh this buffer", icon=":material/scale:", expanded=not folded):
        row = st.columns([2, 4, 4, 2, 2])
        step = _pick_fit(row[0], run)
        policies = [
            other.run_id for other in kept if other.env == run.env and has_policy(other, step)
        ]
        policies.sort(key=lambda name: name != run.run_id)
        policy = row[1].selectbox(
            "By the policy of", [*policies, RANDOM, FOREIGN], key="weigh policy"
        )
        learners = row[2].multiselect(
            "Learners", tuple(LEARNERS), list(WEIGHED_FIRST), key="weigh learners",
            format_func=learner_label,
            filter_mode="contains", select_all=False,
        )  # fmt: skip
        preset = row[3].selectbox(
            "TOM's preset", PRESETS, key="weigh preset",
            help="own: the settings of the buffer's run",
        )  # fmt: skip
        seeds = int(row[4].number_input("Seeds", 1, 10, 2, key="weigh seeds"))
        by = _foreign_policy() if policy == FOREIGN else str(policy)
        words = command(run, by, learners, str(preset), seeds, session.links().store, step)
        st.code(form.shown(words), language="bash", wrap_lines=True)
        if why := session.looks_on():
            st.caption(why)
        elif policy == FOREIGN or is_code(run.env):
            st.caption("It runs code of yours, so it is started in a terminal.")
        elif st.button("Weigh", type="primary", disabled=not learners, key="weigh"):
            st.session_state["weighing"] = trainings.start(words)
        if run.run_id not in policies and not empty.left_out(run, "policy"):
            st.caption("This run holds no policy of its own: it is written when a run has ended.")
    _progress()


def _foreign_policy() -> str:
    """A policy that is not from a run, in the form that `tom weigh` accepts."""
    typed = st.text_input("File or function", placeholder=FOREIGN, key="weigh foreign")
    return typed or "POLICY"


def _pick_fit(place: DeltaGenerator, run: RunInfo) -> int | None:
    """The chosen fit (or `?at=`), one whose policy the run stored; None for the run's end."""
    steps = [str(step) for step in readers.policy_steps(run)]
    asked = st.session_state.get("at", st.query_params.get("at", END))
    if asked not in (END, *steps):
        st.session_state.pop("at", None)  # it was chosen for another run
        st.caption(f"This run keeps no policy of step {text.markdown(asked)}: its end is taken.")
    empty.left_out(run, "policies")
    chosen = place.selectbox(
        "As it was at step", [END, *steps], key="at", bind="query-params",
        help="the buffer and the policies at that fit; the steps are those where both were kept",
    )  # fmt: skip
    return None if chosen in (None, END) else int(chosen)


def has_policy(run: RunInfo, step: int | None) -> bool:
    """Whether the run has stored its policy of the fit at `step` (None: its last policy)."""
    return readers.reader(run).has_policy(step)


def command(
    run: RunInfo,
    policy: str,
    learners: list[str],
    preset: str,
    seeds: int,
    store: str,
    step: int | None = None,
) -> list[str]:
    """The arguments of `tom` that weigh a run's buffer at `step`, or at its end."""
    at = [] if step is None else ["--step", str(step)]
    code = ["--env", run.env] if is_code(run.env) else []
    seed_words = [str(seed) for seed in range(seeds)]
    return [
        "weigh", run.run_id, "--policy", policy, *code, *at, "--learner", *learners,
        "--seeds", *seed_words, "--preset", preset, "--store", store,
    ]  # fmt: skip


@st.fragment(run_every=2)
def _progress() -> None:
    """The output of the weighing started here; the page is redrawn when it is done."""
    begun: Started | None = st.session_state.get("weighing")
    if begun is None:
        return
    if begun.process.poll() is None:
        last = begun.tail().splitlines()[-1:] or ["started"]
        st.caption(f"Weighing: {text.markdown(last[0])}")
        return
    if begun.process.returncode:
        st.error("The weighing ended without a result:", icon=":material/error:")
        st.code(begun.tail(), language=None)
        return
    del st.session_state["weighing"]
    st.rerun()
