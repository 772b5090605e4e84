"""Messages instead of missing content: an empty store, parts that a small copy lacks."""

import shlex
from collections.abc import Sequence
from pathlib import Path

import streamlit as st

from app import session, text
from app.data import readers, trainings, weighings
from app.parts import again, widgets
from app.parts.scope import Scope
from tom.record.reader import RunReader

EXAMPLES = Path(__file__).parents[2] / "runs"
"""the gallery, where the studio runs from a clone"""
EVALUATIONS = "evaluations"
"""what a small copy lacks that has no replay"""


def page() -> None:
    """How to begin: a first comparison, a training of one's own, the examples."""
    store = session.links().store
    st.header("Which data does a learned model pay attention to?", anchor=False)
    st.write(
        "This studio shows it while the model trains, and whether it helps. Nothing is recorded "
        "in this store yet."
    )
    left, right = st.columns(2)
    with left, st.container(border=True):
        st.subheader("Start a first comparison", anchor=False)
        st.write("TOM and MLE on inverted pendulum, one after the other: about three minutes.")
        if why := session.read_only_reason():
            st.caption(why)
        elif st.button("Start it", type="primary", icon=":material/play_arrow:"):
            words = ["train", "--env", "inverted-pendulum", "--learner", "tom", "mle"]
            trainings.start([*words, "--seeds", "0", "--steps", "2500", "--store", store])
    with right, st.container(border=True):
        st.subheader("Or in a terminal", anchor=False)
        option = f" --store {shlex.quote(store)}"
        st.code(f"tom demo --headless{option}", language="bash")
        st.code(f"tom train --env hopper --learner tom{option}", language="bash")
        if EXAMPLES.is_dir() and EXAMPLES.resolve() != Path(store).resolve():
            st.write("Look at finished runs of five robots first:")
            st.code(f"tom studio --store {shlex.quote(str(EXAMPLES))}", language="bash")
    st.caption(f"Store: {text.markdown(store)}")
    widgets.show_store_problems(readers.listing(store).problems)
    again.when_changed(lambda: bool(readers.listing(store).runs or weighings.datasets(store)), 2)


def left_out(run: RunReader, *parts: str) -> bool:
    """Show which of these parts a small copy lacks; returns False if none.

    One that lacks `other snapshots` may lack all of them.
    """
    names = [name for part in parts for name in (part, part.removeprefix("other "))]
    lacking = [name for name in dict.fromkeys(names) if name in run.left_out]
    if not lacking:
        return False
    recorded = len(widgets.curve(run, "eval/return").step)
    counts = {
        "other evaluations": (len(run.evaluation_steps()), recorded, "evaluations"),
        "other snapshots": (len(run.snapshot_steps()), len(readers.profiles(run).env_step),
                            "fits' single weights"),
    }  # fmt: skip
    kept = [f"{n} of {of} {name}" for key, (n, of, name) in counts.items() if key in lacking]
    others = [name for name in lacking if name not in counts]
    words = [f"Examples keep {' and '.join(kept)}."] if kept else []
    words += [f"Left out of this example: {', '.join(others)}."] if others else []
    st.caption(" ".join(words))
    return True


CALLS = {
    "weights": "`run.weights` records them, `tom.weigh_live(run)` computes them",
    "rows": "`run.transitions` records them",
    "evaluations": "`run.evaluate` plays them, `run.episode` records yours",
}
"""what a loop of one's own calls for its record to have a part"""


def of_own_loop(scope: Scope, shown: RunReader | None, part: str) -> None:
    """Say what the chosen run of a loop of one's own lacks here, and which call would give it."""
    loops = [run for run in scope.runs if run.own_loop]
    asked = [run for run in loops if run.run_id == scope.asked]
    for run in asked or ([] if shown else loops[:1]):
        if shown is None or shown.run_id != run.run_id:
            st.caption(f"{text.markdown(run.run_id)} has no {part}: {CALLS[part]}.")


def left_out_of_all(runs: Sequence[RunReader], part: str) -> bool:
    """Show how many small copies lack a part; returns False if none does."""
    lacking = sum(part in run.left_out for run in runs)
    if lacking:
        copies = "the small copy" if lacking == 1 else f"the {lacking} small copies"
        st.info(f"Left out of {copies} in this store: {part}.", icon=":material/content_cut:")
    return lacking > 0
