"""Every learner's weights of the buffer that a run had at one of its fits."""

from pathlib import Path
from urllib.parse import quote

import streamlit as st

from app import text
from app.data import buffer, weighings
from app.figures.probe import probe_profiles
from app.parts.plot import chart
from app.parts.weighing import show_notices
from app.theme import learner_label
from tom.record.reader import RunReader, at_or_before

HEIGHT = 300


def at_fit(run: RunReader, step: int) -> None:
    """The profiles of all learners on the buffer of the fit at or before `step`, for its policy.

    Shows the result of `tom weigh` there with the most learners, of such the newest, with a link to
    the page that makes one.
    """
    rows = buffer.length(run)
    if not rows:
        return
    stored = sorted(weighings.of_run(run, rows), key=lambda w: (len(w.learners), w.written))
    weighed = {w.step: w for w in stored if Path(w.policy).name == run.run_id}  # an id or a folder
    steps = sorted({*run.policy_steps(), *(at for at in weighed if at is not None)})
    if not steps:
        return
    at = at_or_before(steps, step)
    of = weighed[at].weights() if at in weighed else {}
    address = f"/probe?run={quote(run.run_id)}&at={at}"
    learners = [learner_label(name) for name in dict.fromkeys(name for name, _ in of)]
    if len(learners) < 2:
        st.caption(
            f"What would another learner look at here? [Weigh the buffer of step {at:,} by every "
            f"learner]({address})."
        )
    if not of:
        return
    with st.container(border=True):
        st.markdown(
            f"**{text.markdown(', '.join(learners))} on the buffer of step {at:,}**, by the policy "
            f"of that fit: [Probe]({address}&weighed={quote(weighed[at].name)})",
            help=f"made by `tom weigh --step {at}`, TOM with "
            f"{text.markdown(weighed[at].settings)}, its Q begun afresh, where a run's goes on "
            "from fit to fit; lines are medians over seeds, bands their range; the dotted line "
            "ends the random data",
        )
        show_notices(weighed[at])
        share = weighed[at].ordered_from / weighed[at].rows
        profiles, keep = weighings.profiles(of), weighed[at].name
        figure = probe_profiles(profiles, share, HEIGHT, log=False, keep=keep)
        chart(figure, "same buffer", "weight profiles of all learners on this buffer")
