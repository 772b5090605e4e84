"""Trainings: how to begin, a form that starts them, and a card for each that runs or has ended."""

import html
import os
import shlex
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import streamlit as st
from streamlit.delta_generator import DeltaGenerator

from app import session, text
from app.data import readers, trainings
from app.parts import address, form, jobs, scope, widgets
from app.theme import learner_colour
from tom import readable
from tom.analysis.settings import changed, distinguishing_presets
from tom.envs import ENV_NAMES, OTHERS
from tom.errors import UserError
from tom.learners import SUBJECT, learner_label
from tom.record import checkpoint
from tom.record.reader import SMALL_COPY, RunReader
from tom.record.store import Store
from tom.training.presets import PRESETS, default_preset, learners, resolve

EXAMPLES = Path(__file__).parents[2] / "runs"
"""the gallery, where the studio runs from a clone"""
REFRESH_S = 2
"""seconds between two drawings while a run trains, or one that was started here has not begun"""
RECENT_S, MOST = 900, 6
"""seconds for which a run that has ended is still shown, and the number of those that are"""
IN_ROW, FIELDS_IN_ROW = 3, 4
SEEDS = 16
"""seeds that the form offers"""
MAX_NAMED = 3
FOLD, OPENED = "starting", "start opened"
_STATE_TINTS = {"running": "#1f9d55", "failed": "#d2383f", "dead": "#c77700"}
PLAY = ":material/play_arrow:"
FIRST = "First comparison"


def draw_first_page() -> None:
    """How to begin: a first comparison, a training of one's own, the examples."""
    from app.data import weighings  # here: it imports torch

    store = session.links().store
    st.header("Which data does a learned model pay attention to?", anchor=False)
    st.write(
        "This studio shows it while the model trains, and whether it helps. Nothing is recorded "
        "in this store yet."
    )
    left, right = st.columns(2)
    with left, st.container(border=True):
        st.subheader("Start a first comparison", anchor=False)
        st.write("TOM, then MLE, on the inverted pendulum; about three minutes.")
        if why := session.read_only_reason():
            st.caption(why)
        elif not jobs.is_running(FIRST) and st.button("Start it", type="primary", icon=PLAY):
            words = ["sweep", "--env", "inverted-pendulum", "--learner", "tom", "mle"]
            jobs.start(FIRST, [*words, "--seeds", "0", "--steps", "2500", "--store", store])
            st.rerun()
        jobs.show(FIRST)
    with right, st.container(border=True):
        st.subheader("Or in a terminal", anchor=False)
        option = f" --store {shlex.quote(store)}"
        st.code(f"tom demo --headless{option}", language="bash", wrap_lines=True)
        words = f"tom train --env hopper --learner tom{option}"
        st.code(words, language="bash", wrap_lines=True)
        if EXAMPLES.is_dir() and EXAMPLES.resolve() != Path(store).resolve():
            st.write("Look at finished runs of five robots first:")
            words = f"tom studio --store {shlex.quote(str(EXAMPLES))}"
            st.code(words, language="bash", wrap_lines=True)
    st.caption(f"Store: {text.markdown(store)}")
    scope.frame(())
    widgets.show_store_problems(readers.listing(store).problems)
    widgets.redraw_when_changed(
        lambda: bool(readers.listing(store).runs or weighings.datasets(store)), 2
    )


def draw() -> None:
    """The form, and a card for each training that runs or has just ended."""
    _form()
    runs = readers.listing(session.links().store).runs
    waits = any(run.status.alive for run in runs) or any(
        map(jobs.is_running, list(jobs.started_commands()))
    )
    st.fragment(_cards, run_every=REFRESH_S if waits else None)()


def _form() -> None:
    """Environment, learner, seeds, steps, preset; all other settings are folded.

    The fields are made when the form is first opened, and then keep their values.
    """
    fold = st.expander("Start a training", icon=PLAY, key=FOLD, on_change="rerun")
    if not (fold.open or st.session_state.get(OPENED)):
        return
    st.session_state[OPENED] = True
    with fold:
        if why := session.read_only_reason():
            st.caption(why)
            return
        row = st.columns([3, 3, 2, 2, 2])
        env = row[0].selectbox("Environment", [*ENV_NAMES, *OTHERS], key="start env")
        names = learners(env)
        learner = row[1].selectbox(
            "Learner", names, names.index(SUBJECT), key="start learner", format_func=learner_label
        )
        own = default_preset(env, learner)
        st.session_state.setdefault("start preset", own)
        address.follow_default("start preset", own)
        preset = row[2].selectbox(
            "Preset", list(PRESETS), key="start preset",
            help="paper: the paper's table (appendix C.1); mended: the same with TOM's objective "
            "repaired; released: with the released code's choices; mbpo: Janner's MBPO; smoke: "
            "small and quick",
        )  # fmt: skip
        st.session_state.setdefault("start seeds", [0])
        seeds = row[3].multiselect(
            "Seeds", range(SEEDS), key="start seeds", help="one training per seed"
        )
        try:
            usual = resolve(env, learner, preset).steps
        except UserError as error:  # a plug-in's task that cannot be made
            st.error(str(error))
            return
        steps = row[4].number_input(
            "Steps", 1, None, usual, key=f"start steps {env} {preset}", help="of each run"
        )
        given = {"steps": str(steps)} if steps != usual else {}
        with st.expander("More settings (empty: the preset's value)"):
            given |= _settings(form.sections(env, learner, preset))
        try:
            store = session.links().store
            commands = [
                form.train_arguments(env, learner, preset, seed, given, store) for seed in seeds
            ]
        except UserError as error:
            st.error(text.markdown(error), icon=":material/error:")
            return
        if commands:
            _start_button(commands)


def _settings(groups: dict[str, list[form.Setting]]) -> dict[str, str]:
    given: dict[str, str] = {}
    for tab, settings in zip(st.tabs(list(groups)), groups.values(), strict=True):
        row: Sequence[DeltaGenerator] = ()
        for i, setting in enumerate(settings):
            if i % FIELDS_IN_ROW == 0:
                row = tab.columns(FIELDS_IN_ROW)
            path, label, words, default, choices = setting
            field: dict[str, Any] = {
                "key": f"start set {path}", "help": text.markdown(words) or None,
            }  # fmt: skip
            column = row[i % FIELDS_IN_ROW]
            typed = (
                column.selectbox(label, choices, index=None, placeholder=default, **field)
                if choices
                else column.text_input(label, placeholder=default, **field)
            )
            chosen = (typed or "").strip()
            if chosen and chosen != default:
                given[path] = chosen
    return given


def _start_button(commands: Sequence[Sequence[str]]) -> None:
    """The button that starts these trainings, and the first one's command."""
    many = len(commands) > 1
    left, right = st.columns([1, 4], vertical_alignment="center")
    label = f"Start {len(commands)} trainings" if many else "Start"
    if left.button(label, type="primary", icon=PLAY, key="start"):
        for words in commands:
            if not jobs.is_running(name := form.command_line(words)):  # else by a second click
                jobs.start(name, words)
        st.toast("Started. It appears below in a few seconds.", icon=PLAY)
    right.code(form.command_line(commands[0]), language="bash", wrap_lines=True)
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    others = f" The others differ only in the seed. {len(commands)} trainings on {cores} cores."
    st.caption("Runs on this machine, and continues if the studio is closed." + others * many)


def _cards() -> None:
    runs = readers.listing(session.links().store).runs
    writers = {run.status.pid for run in runs}
    for name, command in list(jobs.started_commands().items()):
        # One that has written a run has a card.
        if (
            command.arguments[0] == "train"
            and command.process.poll()
            and command.process.pid not in writers
        ):
            jobs.show(name)
    alive = [run for run in runs if run.status.alive]
    recent = [run for run in runs if time.time() - run.status.heartbeat < RECENT_S]
    ended = [run for run in recent if not run.status.alive and not run.small_copy]
    shown = [*alive, *ended[:MOST]]
    width = 2 if len(shown) == 4 else min(len(shown), IN_ROW)
    presets = distinguishing_presets(runs)
    preset = {run.run_id: words for run, words in zip(runs, presets, strict=True)}
    row: Sequence[DeltaGenerator] = ()
    for i, run in enumerate(shown):
        if i % width == 0:
            row = st.columns(width)
        with row[i % width], st.container(border=True, gap="small"):
            _card(run, preset[run.run_id])


def _card(run: RunReader, preset: str) -> None:
    """Name and state, progress, and the main numbers; `preset` if its learner has several."""
    status = run.status
    if status.alive and not session.read_only_reason() and not run.own_loop:
        left, right = st.columns([4, 1], vertical_alignment="center", gap="small")
        left.html(card_heading(run, preset))
        with right:
            _stop(run)
    else:
        _asked_to_stop().discard(run.run_id)
        st.html(card_heading(run, preset))
    st.progress(status.share, text=text.markdown(progress_line(run)))
    with st.container(horizontal=True):  # a card of three in a row is too narrow for one line
        for label, value in main_numbers(run).items():
            st.metric(label, value, width="content")
    # The run's record does not know the folder that this studio's terminal would need to be in.
    reason = status.reason.replace(f"tom train --resume {run.run_id}", resume_command(run))
    for words in (settings_line(run), reason, *status.warnings):
        if words:
            st.caption(text.markdown(words))
    if status.shown == "dead" and checkpoint.newest(run.path / checkpoint.FOLDER) is not None:
        st.caption("To go on from its last checkpoint:")
        st.code(resume_command(run), language="bash", wrap_lines=True)
    if log := log_of(run):
        with st.expander("Last lines of its output", key=f"log {run.run_id}", on_change="rerun"):
            st.code(log, language=None)


def main_numbers(run: RunReader) -> dict[str, str]:
    """The returns, and the speed of a training run, which is unknown during a fit."""
    status = run.status
    numbers = {
        "last return": readable.score(status.last_return),
        "best return": readable.score(status.best_return),
    }
    if status.alive:
        memory = trainings.memory(status.pid, run.path)
        numbers |= {
            "steps / s": readable.number(status.env_steps_per_s or None),
            "ETA": readable.duration(status.eta_s),
            "memory": readable.size(memory) if memory else readable.UNKNOWN,
        }
    return numbers


def log_of(run: RunReader) -> str:
    """The last lines of a training's output, if it was started here; else empty."""
    commands = [
        one for one in list(jobs.started_commands().values()) if one.process.pid == run.status.pid
    ]
    return commands[-1].tail() if commands else ""


def _stop(run: RunReader) -> None:
    if run.run_id in _asked_to_stop():
        st.caption("stopping", help="it finishes its step and writes a checkpoint")
        return
    # on_change: it stays open when the page is drawn again
    with st.popover("Stop", key=f"stop {run.run_id}", width="stretch", on_change="rerun"):
        st.write("The training finishes its step and writes a checkpoint. To continue it later:")
        st.code(resume_command(run), language="bash")
        if st.button("Stop this training", key=f"stop {run.run_id} now", type="primary"):
            try:
                trainings.stop(Store(session.links().store), run.run_id)
                _asked_to_stop().add(run.run_id)
                st.rerun(scope="fragment")
            except UserError as error:
                st.error(text.markdown(error))


def resume_command(run: RunReader) -> str:
    """The command that resumes a run, for a terminal in any folder."""
    return form.command_line(["train", "--resume", run.run_id, "--store", session.links().store])


def _asked_to_stop() -> set[str]:
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
    more = [f"and {len(words) - MAX_NAMED} more"] if len(words) > MAX_NAMED else []
    return ", ".join(words[:MAX_NAMED] + more)


def card_heading(run: RunReader, preset: str = "") -> str:
    """The card's first line as HTML; everything that came from a file is escaped."""
    shown = run.status.shown
    tint = _STATE_TINTS.get(shown, "currentColor")
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
        f'<span style="margin-left:auto;flex:none;border:1px solid {tint};'
        f'border-radius:1rem;padding:0 .55rem;font-size:.8em">{html.escape(shown)}</span></div>'
    )
