"""The trainings that run now or have just ended: their cards, and how to start and stop them."""

import html
import shlex
import time
from collections.abc import Sequence

import streamlit as st

from app import session, text
from app.data import readers, trainings
from app.parts import start
from app.theme import learner_colour, learner_label
from tom import readable
from tom.analysis.settings import changed, telling_presets
from tom.errors import UserError
from tom.record.reader import SMALL_COPY, RunReader
from tom.record.store import Store

REFRESH_S = 2
"""seconds between two drawings while a run trains, or one that was started here has not begun"""
RECENT_S, MOST = 900, 6
"""seconds for which a run that has ended is still shown, and the number of those that are"""
COLUMNS = 3
NAMED = 3
"""maximum number of changed settings that a card names"""
_STATE_TINTS = {
    "running": "#1f9d55",
    "failed": "#d2383f",
    "dead": "#c77700",
}


def draw() -> None:
    """How to start one, and a card for each of them."""
    start.panel()
    runs = readers.listing(session.links().store).runs
    waits = any(run.status.alive for run in runs) or start.waits(runs)
    st.fragment(_strip, run_every=REFRESH_S if waits else None)()


def _strip() -> None:
    runs = readers.listing(session.links().store).runs
    start.failures(runs)
    alive = [run for run in runs if run.status.alive]
    ended = [run for run in runs if just_ended(run)][:MOST]
    if alive or ended:
        cards([*alive, *ended], runs)


def just_ended(run: RunReader) -> bool:
    """Whether a run has ended a short while ago."""
    recent = time.time() - run.status.heartbeat < RECENT_S
    return recent and not run.status.alive and not run.small_copy


def cards(runs: Sequence[RunReader], among: Sequence[RunReader]) -> None:
    """One card per run, in rows; it names the preset where a learner has several `among` runs."""
    width = 2 if len(runs) == 4 else min(len(runs), COLUMNS)
    telling = telling_presets(among)
    preset = {run.run_id: words for run, words in zip(among, telling, strict=True)}
    for first in range(0, len(runs), width or 1):
        row = st.columns(width)
        for column, i in zip(row, range(first, min(first + width, len(runs))), strict=False):
            with column, st.container(border=True, gap="small"):
                card(runs[i], preset.get(runs[i].run_id, ""))


def card(run: RunReader, preset: str = "") -> None:
    """Name and state, progress, and the main numbers.

    The `preset` tells it from other runs of its learner.
    """
    status = run.status
    if status.alive and session.may_act() and not run.own_loop:
        left, right = st.columns([4, 1], vertical_alignment="center", gap="small")
        left.html(head(run, preset))
        with right:
            _stop(run)
    else:
        _asked().discard(run.run_id)
        st.html(head(run, preset))
    st.progress(status.share, text=text.markdown(progress_line(run)))
    numbers = figures(run)
    for column, (label, value) in zip(st.columns(len(numbers), gap="small"), numbers, strict=True):
        column.metric(label, value)
    # The run's record does not know the folder that this studio's terminal would need to be in.
    whole = resume(run, session.links().store)
    reason = status.reason.replace(f"tom train --resume {run.run_id}", whole)
    for words in (settings_line(run), reason, *status.warnings):
        if words:
            st.caption(text.markdown(words))
    if log := start.log_of(run):
        with st.expander("Last lines of its output", key=f"log {run.run_id}", on_change="rerun"):
            st.code(log, language=None)


def figures(run: RunReader) -> list[tuple[str, str]]:
    """The returns, and the speed of a training run, which is unknown during a fit."""
    status = run.status
    memory = trainings.memory(status.pid, run.path) if status.alive else None
    numbers = [
        ("last return", readable.score(status.last_return)),
        ("best return", readable.score(status.best_return)),
    ]
    if status.alive:
        numbers.append(("steps / s", readable.number(status.env_steps_per_s or None)))
        numbers.append(("ETA", readable.duration(status.eta_s)))
        numbers.append(("memory", readable.size(memory) if memory else readable.UNKNOWN))
    return numbers


def _stop(run: RunReader) -> None:
    if run.run_id in _asked():
        st.caption("stopping", help="it ends after its step and writes a checkpoint")
        return
    # on_change: it stays open when the page is drawn again
    with st.popover("Stop", key=f"stop {run.run_id}", width="stretch", on_change="rerun"):
        st.write("The training ends after this step and writes a checkpoint. To go on with it:")
        st.code(resume(run, session.links().store), language="bash")
        if st.button("Stop this training", key=f"stop {run.run_id} now", type="primary"):
            try:
                trainings.stop(Store(session.links().store), run.run_id)
                _asked().add(run.run_id)
                st.rerun(scope="fragment")
            except UserError as error:
                st.error(text.markdown(error))


def resume(run: RunReader, store: str) -> str:
    """The command that resumes a run, for a terminal in any folder."""
    return shlex.join(["tom", "train", "--resume", run.run_id, "--store", store])


def _asked() -> set[str]:
    """The runs that this user has asked to stop and that have not ended yet."""
    return st.session_state.setdefault("asked to stop", set())


def progress_line(run: RunReader) -> str:
    """The progress of the run, the last sign of a dead one, and whether it is a small copy."""
    status = run.status
    steps = f"{status.env_step:,} of {status.total:,} steps"
    if run.small_copy:
        return f"{steps} · {SMALL_COPY}"
    if status.alive:
        return f"{steps} · {status.phase}" if status.phase else steps
    if status.shown == "dead":
        return f"{steps} · no sign of life for {readable.duration(time.time() - status.heartbeat)}"
    return steps


def settings_line(run: RunReader) -> str:
    """The settings in which the run differs from its preset; empty if that is not known here."""
    try:
        new = changed(run)
    except UserError:
        return ""
    words = [f"{path} {value}" for path, value in new.items()]
    more = [f"and {len(words) - NAMED} more"] if len(words) > NAMED else []
    return ", ".join(words[:NAMED] + more)


def head(run: RunReader, preset: str = "") -> str:
    """The card's first line as HTML; everything that came from a file is escaped."""
    shown = run.status.shown
    tint = _STATE_TINTS.get(shown, "inherit")
    learner = html.escape(" ".join(filter(None, (learner_label(run.learner), preset))))
    called = f" · {run.labels.name}" if run.labels.name else ""
    about = html.escape(f"{run.env} · seed {run.seed}{called}")
    return (
        '<div style="display:flex;flex-wrap:wrap;align-items:center;gap:0 .5rem;min-width:0">'
        f'<span style="width:.75rem;height:.75rem;border-radius:50%;flex:none;'
        f'background:{learner_colour(run.learner)}"></span>'
        f'<b style="white-space:nowrap">{learner}</b>'
        '<span style="opacity:.7;overflow:hidden;text-overflow:ellipsis;white-space:nowrap" '
        f'title="{html.escape(run.run_id, quote=True)}">{about}</span>'
        f'<span style="margin-left:auto;flex:none;color:{tint};border:1px solid;'
        f'border-radius:1rem;padding:0 .55rem;font-size:.8em">{html.escape(shown)}</span></div>'
    )
