"""What several pages show: viewers, links, and words in place of what is missing."""

from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType

import streamlit as st

from app import session, text
from app.data import readers
from app.links import LIVE
from app.parts import address
from app.scenes.control import Choice, Selection, send_selection
from tom.analysis.curves import Curve, curve_of
from tom.analysis.grouping import has_uniform_learner
from tom.analysis.weight_readers import first_weight_reader
from tom.learners import SUBJECT
from tom.record.reader import RunReader

EVALUATIONS = "evaluations"
"""what a small copy lacks that has no replay"""


def curve(run: RunReader, metric: str) -> Curve:
    """One metric of a run against env steps."""
    return curve_of(run, readers.metrics(run), metric)


def interest_key(run: RunReader) -> tuple[object, ...]:
    """A sort key: runs with uneven weights first, then one's own before examples, then the rank of
    their learner, the longest and the most complete."""
    return (
        not has_uneven_weights(run), run.small_copy, run.learner != SUBJECT, run.preset != "mended",
        -run.status.env_step, len(run.left_out),
    )  # fmt: skip


def has_uneven_weights(run: RunReader) -> bool:
    """Whether the weights of the run's last fit are not uniform."""
    if has_uniform_learner(run):
        return False  # known without reading
    profiles = readers.profiles(first_weight_reader(run))
    return len(profiles.ess) > 0 and bool(profiles.ess[-1] < 0.99)


def metrics(numbers: Mapping[str, str], helps: Mapping[str, str] = MappingProxyType({})) -> None:
    """Single numbers in a row, and what some of them are, by their labels."""
    with st.container(horizontal=True, horizontal_alignment="distribute"):
        for label, value in numbers.items():
            st.metric(label, value, help=helps.get(label), width="content")


def show_problems(run: RunReader, problems: Sequence[str] | None = None) -> None:
    for problem in readers.problems(run) if problems is None else problems:
        st.warning(
            f"{text.markdown(run.run_id)}: {text.markdown(problem)}", icon=":material/heart_broken:"
        )


def show_store_problems(problems: Sequence[str]) -> None:
    """Show the folders of the store that are not runs, folded."""
    if problems:
        with st.expander(f"{len(problems)} in this store could not be read as a run"):
            for problem in problems:
                st.text(problem)


def show_left_out(run: RunReader, *parts: str) -> bool:
    """Show which of these parts a small copy lacks; returns False if none.

    One that lacks `other snapshots` may lack all of them.
    """
    names = [name for part in parts for name in (part, part.removeprefix("other "))]
    lacking = [name for name in dict.fromkeys(names) if name in run.left_out]
    if not lacking:
        return False
    recorded = len(curve(run, "eval/return").step)
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


def show_left_out_of_all(runs: Sequence[RunReader], part: str) -> bool:
    """Show how many small copies lack a part; returns False if none does."""
    lacking = sum(part in run.left_out for run in runs)
    if lacking:
        copies = "the small copy" if lacking == 1 else f"the {lacking} small copies"
        st.info(f"Left out of {copies} in this store: {part}.", icon=":material/content_cut:")
    return lacking > 0


def link_to(path: str, label: str, **choices: str) -> None:
    """A link to another page of this studio, with what all pages share and further choices."""
    pages = st.session_state.get("pages", {})
    if path in pages:  # else this page is drawn alone
        st.page_link(
            pages[path], label=label, icon=":material/arrow_forward:",
            query_params=address.shared() | {name: [word] for name, word in choices.items()},
        )  # fmt: skip


def redraw_when_changed(state: Callable[[], object], every_s: float) -> None:
    """Draw the whole page again when `state`, looked at every few seconds, is another than now."""
    seen: dict[str, object] = {}

    @st.fragment(run_every=every_s)
    def poll() -> None:
        now = state()
        if now != seen.setdefault("first", now):
            st.rerun()

    poll()


def show_scene(choice: Choice, height: int, part: str = "") -> None:
    """Show `choice` in 3D. A rerun of the page does not reload the frame.

    A page with several frames gives each a different `part`.
    """
    links = session.links()
    if not links.folder:
        st.caption("For the 3D scene, start the studio with `tom studio`.")
        return
    client = f"{session.client()}{part}"
    try:
        send_selection(str(links.file("control")), client, Selection(choice, session.mode()))
    except OSError:
        last_line = links.file("scenes.log").read_text(errors="replace").strip().rpartition("\n")[2]
        st.warning(
            f"The 3D server does not answer and is being restarted. {text.markdown(last_line)}"
        )
    st.iframe(links.viser(client, session.mode()), height=height, alt="3D scene")


def show_rerun(run: RunReader, height: int, name: str = "") -> None:
    """Rerun's viewer with a recording, by default all of a run's, or live while it trains.

    A rerun of the page does not reload it.
    """
    links = session.links()
    if not links.folder:
        st.caption("For the Rerun viewer, start the studio with `tom studio`.")
        return
    recorded = readers.recordings(run)
    every = [LIVE] if run.status.alive or not recorded else recorded
    path = links.rerun(run.run_id, [name] if name else every, session.mode())
    st.iframe(path, height=height, alt="Rerun viewer")
