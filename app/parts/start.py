"""A form that starts trainings, made from the configuration and checked before the start."""

import os
from collections.abc import Iterable, Sequence
from contextlib import suppress

import streamlit as st

from app import session, text
from app.data import trainings
from app.data.trainings import Started
from app.parts import address, form
from app.theme import learner_label
from tom.envs import ENV_NAMES, OTHERS
from tom.errors import UserError
from tom.learners import SUBJECT
from tom.record.reader import RunReader
from tom.training.presets import PRESETS, default_preset, learners

COLUMNS = 4
FORGET = 6
"""trainings started here that are remembered after their end, and failures that are shown"""

FOLD, OPENED = "starting", "start opened"


def panel() -> None:
    """Environment, learner, seeds, steps, preset; all other settings are folded.

    The fields are made when the form is first opened, and then keep their values.
    """
    icon = ":material/play_arrow:"
    fold = st.expander("Start a training", icon=icon, key=FOLD, on_change="rerun")
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
        address.follow("start preset", own)
        preset = row[2].selectbox(
            "Preset",
            list(PRESETS),
            key="start preset",
            help="paper: the paper's table (appendix C.1); mended: the same with TOM's objective "
            "mended; released: with the released code's choices; mbpo: Janner's MBPO; smoke: small "
            "and quick",
        )
        seeds = row[3].text_input(
            "Seeds", "0", key="start seeds", help="one training each: 0, or 0-2, or 0, 3"
        )
        try:
            usual = form.default_steps(env, learner, preset)
        except UserError as error:  # a plug-in's task that cannot be made
            st.error(str(error))
            return
        steps = row[4].number_input(
            "Steps", 1, None, usual, key=f"start steps {env} {preset}", help="env steps of each run"
        )
        given = {"steps": str(steps)} if steps != usual else {}
        with st.expander("More settings: empty means the preset's value"):
            given |= _settings(env, learner, preset)
        _begin(env, learner, preset, seeds, given)


def _settings(env: str, learner: str, preset: str) -> dict[str, str]:
    """The changed settings by path."""
    given: dict[str, str] = {}
    groups = form.sections(env, learner, preset)
    for tab, settings in zip(st.tabs(list(groups)), groups.values(), strict=True):
        with tab:
            for first in range(0, len(settings), COLUMNS):
                row = st.columns(COLUMNS)
                for column, setting in zip(row, settings[first : first + COLUMNS], strict=False):
                    with column:
                        words = _field(setting)
                    if words and words != setting.default:
                        given[setting.path] = words
    return given


def _field(setting: form.Setting) -> str:
    key = f"start set {setting.path}"
    words = text.markdown(setting.help) or None
    if setting.choices:
        chosen = st.selectbox(
            setting.label,
            setting.choices,
            index=None,
            placeholder=setting.default,
            key=key,
            help=words,
        )
        return chosen or ""
    typed = st.text_input(setting.label, placeholder=setting.default, key=key, help=words)
    return (typed or "").strip()


def _begin(env: str, learner: str, preset: str, seeds: str, given: dict[str, str]) -> None:
    try:
        store = session.links().store
        commands = [
            form.command(env, learner, preset, seed, given, store) for seed in form.seeds(seeds)
        ]
    except UserError as error:
        st.error(text.markdown(error), icon=":material/error:")
        return
    many = len(commands) > 1
    left, right = st.columns([1, 4], vertical_alignment="center")
    if left.button(
        f"Start {len(commands)} trainings" if many else "Start",
        type="primary",
        icon=":material/play_arrow:",
        key="start",
    ):
        _remember(trainings.start(words) for words in commands)
        st.toast("Started: it appears below in a few seconds.", icon=":material/play_arrow:")
    with right:
        st.code(form.shown(commands[0]), language="bash", wrap_lines=True)
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    many_words = f" The others differ in the seed. {len(commands)} trainings on {cores} cores."
    st.caption(
        "Runs on this machine, and goes on when the studio is closed."
        + (many_words if many else "")
    )


def failures(runs: Sequence[RunReader]) -> None:
    """Trainings started here that ended before they had a run, with their output."""
    for begun in failed(runs)[-FORGET:]:
        st.error("A training that was started here did not begin:", icon=":material/error:")
        st.code(f"$ {form.shown(begun.words)}\n{begun.tail()}", language=None)


def failed(runs: Sequence[RunReader]) -> list[Started]:
    """Trainings started here that ended before they had one of the `runs`, all those known."""
    writers = {run.status.pid for run in runs}
    return [begun for begun in _started() if begun.failed(writers)]


def waits(runs: Sequence[RunReader]) -> bool:
    """Whether a training that was started here has none of the `runs`, all those known, yet."""
    writers = {run.status.pid for run in runs}
    return any(
        begun.process.poll() is None and begun.process.pid not in writers for begun in _started()
    )


def log_of(run: RunReader) -> str:
    """The last lines of a training's output, if it was started here; else empty."""
    begun = [one for one in _started() if one.process.pid == run.status.pid]
    return begun[-1].tail() if begun else ""


def _remember(more: Iterable[Started]) -> None:
    """Add trainings; forget those before the last `FORGET` that have ended, with their output."""
    begun = _started()
    begun.extend(more)
    for old in begun[:-FORGET]:
        if old.process.poll() is not None:
            with suppress(ValueError):  # another page has just forgotten it
                begun.remove(old)


@st.cache_resource(show_spinner=False)
def _started() -> list[Started]:
    """The started trainings, one list for all pages of this studio."""
    return []
