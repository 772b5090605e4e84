"""Start a weighing of a buffer, or show the command that weighs it in a terminal."""

import streamlit as st
from streamlit.delta_generator import DeltaGenerator

from app import session
from app.data import trainings
from app.data.weighings import Dataset
from app.parts import address, empty, form
from app.theme import learner_label
from app.views.attention import progress
from tom.analysis.weighing import POLICIES, PRESETS, RANDOM
from tom.data.datasets import FORMATS
from tom.envs import ANY, ENVS, is_code
from tom.learners import LEARNERS, WEIGHED_FIRST, follows_behaviour
from tom.record.reader import RunReader

END = "the end"
FOREIGN = "policy.pt, policy.onnx or module:function"
STARTED = "weighing"
"""the process that this page started, in the session"""


def draw(run: RunReader, kept: list[RunReader], *, folded: bool) -> None:
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
        usable = [name for name in LEARNERS if run.keeps_behaviour() or not follows_behaviour(name)]
        learners = row[2].multiselect(
            "Learners", usable, list(WEIGHED_FIRST), key="weigh learners",
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
        if why := session.read_only_reason():
            st.caption(why)
        elif policy == FOREIGN or is_code(run.env):
            st.caption("It runs code of yours, so it is started in a terminal.")
        elif st.button("Weigh", type="primary", disabled=not learners, key="weigh"):
            st.session_state[STARTED] = trainings.start(words)
        if len(usable) < len(LEARNERS):
            lacking = ", ".join(learner_label(name) for name in LEARNERS if name not in usable)
            st.caption(f"{lacking}: this run does not say which policies drew its actions.")
        if run.run_id not in policies and not empty.left_out(run, "policy"):
            st.caption("This run holds no policy of its own: it is written when a run has ended.")
    progress.show(STARTED)


def draw_again(run: Dataset) -> None:
    """Show the command that weighs a data set, because pages do not look for the user's files."""
    with st.expander("Weigh this data", icon=":material/scale:"):
        st.caption("No run collected it, so it is weighed in a terminal, where it lies by now:")
        words = run.words(session.links().store)
        st.code(form.shown(words), language="bash", wrap_lines=True)
        st.caption("It was last weighed by:")
        st.code(run.command, language="bash", wrap_lines=True)


def draw_own() -> None:
    """Show the command that weighs data and policies of other libraries."""
    with st.expander("Data and policies of your own", icon=":material/upload_file:"):
        words = ["weigh", "DATA", "--policy", "POLICY", "--env", "ENV"]
        st.code(form.shown([*words, "--store", session.links().store]), language="bash")
        st.caption(f"DATA: a run (id or folder), {FORMATS}, oldest transition first.")
        st.caption(f"POLICY: {POLICIES}.")
        st.caption(f"ENV: {', '.join(ENVS)}, {ANY}. A run and its policy know theirs.")


def _foreign_policy() -> str:
    """A policy that is not from a run, in the form that `tom weigh` accepts."""
    typed = st.text_input("File or function", placeholder=FOREIGN, key="weigh foreign")
    return typed or "POLICY"


def _pick_fit(place: DeltaGenerator, run: RunReader) -> int | None:
    """The chosen fit, one whose policy the run stored; None for the run's end."""
    empty.left_out(run, "policies")
    chosen = address.choose_one(
        place.selectbox, "As it was at step", [END, *run.policy_steps()], "at", END,
        lambda step: str(step) if step == END else f"{step:,}",
        help="the buffer and the policies at that fit; the steps are those where both were kept",
    )  # fmt: skip
    return None if chosen == END else int(chosen)


def has_policy(run: RunReader, step: int | None) -> bool:
    """Whether the run has stored its policy of the fit at `step` (None: its last policy)."""
    return run.has_policy(step)


def command(
    run: RunReader,
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
