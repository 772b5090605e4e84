"""Attention: which rows of the replay buffer get weight, at every fit, and what they are."""

from functools import partial

import numpy as np
import streamlit as st

from app import session, text
from app.data import buffer, readers, weighings
from app.data.answer import newest_share
from app.data.cache import VersionedCache
from app.data.called import names
from app.figures.base import steps_in_words
from app.figures.weights import FLOOR, weight_map, weight_profile, with_returns
from app.parts import address, empty, readout, timeline, widgets
from app.parts.plot import Drawn, Follow, Point, chart
from app.parts.readout import Number
from app.parts.scope import Scope
from app.theme import learner_label
from app.views.attention import exam, in_buffer, learners, road
from app.views.attention.in_buffer import pick_data
from tom import readable
from tom.envs import ROAD
from tom.learners import LEARNERS
from tom.learners.base import DEGENERATE
from tom.record.decode import Profiles
from tom.record.reader import RunReader, at_or_before
from tom.record.status import Status
from tom.record.thin import FITS

ONE, LEARNERS_ON_IT = "One learner's weights", "Every learner on one buffer"
EVEN = 0.9999
"""effective sample size (share) from which weights count as uniform"""
HEIGHT = 270
"""of the figures over time, in pixels"""
_MAPS: VersionedCache[Drawn] = VersionedCache()


def page(scope: Scope) -> None:
    """A run's weights over its fits and in its buffer, or those of all learners for one buffer."""
    part = address.choose_one(
        st.segmented_control, "Part", [ONE, LEARNERS_ON_IT], "part", ONE, required=True,
        label_visibility="collapsed",
    )  # fmt: skip
    if part == LEARNERS_ON_IT:
        learners.draw(scope)
        return
    data = {one.run_id: one for one in weighings.datasets(session.links().store)}
    run = data.get(scope.asked) or scope.one(
        lambda run: bool(readers.weighers(run)), widgets.telling
    )
    if data:
        run = pick_data(st.columns([1, 2])[0], data, run)
    empty.of_own_loop(scope, run, "weights")
    if run is None:
        st.info("No run here has fitted a model yet: weights come with the first fit.")
        return
    asked = [one for one in scope.runs if one.run_id == scope.asked]
    if asked and run.run_id not in (*data, scope.asked):
        st.info("The chosen run has not fitted a model yet: weights come with the first fit.")
        return
    run = _pick_weigher(run)
    profiles = readers.profiles(run)
    fits, evaluations = profiles.env_step.tolist(), run.evaluation_steps()
    if run.run_id in data:
        in_buffer.draw(run, 0)
    elif not fits:
        st.warning("The weight profiles of this run cannot be read.")
    else:
        step = timeline.chosen(sorted({*fits, *evaluations}))
        called = text.markdown(names(scope.runs)[run.run_id])
        st.header(f"Which data {called} pays attention to", anchor=False)
        if run.env == ROAD:
            road.draw(scope, run, step)
        else:
            _numbers(run, profiles)
            _even(run, profiles, fits.index(at_or_before(fits, step)))
            exam.say(run, at_or_before(fits, step))
            _over_time(run, profiles, at_or_before(fits, step))
        in_buffer.draw(run, at_or_before(fits, step))
        if run.env != ROAD:
            _elsewhere(run, step)
        timeline.draw(fits, evaluations, step)
    widgets.show_problems(run)


def _pick_weigher(run: RunReader) -> RunReader:
    """The run seen with the weights of one learner: its own, or live ones."""
    found = readers.weighers(run) or {run.learner: run}
    chosen = next(iter(found))
    if len(found) > 1:
        chosen = address.choose_one(
            st.segmented_control, "Weights by", list(found), "by", chosen, learner_label,
            required=True,
        )  # fmt: skip
    run = found[chosen]
    live = run.status if run.home != run.path else Status()  # no card shows it
    for words in filter(None, (*live.warnings, live.reason)):
        st.caption(text.markdown(words))
    return run


def _over_time(run: RunReader, profiles: Profiles, fit: int) -> None:
    """The weights of all fits by age, with the returns, and the profile of one."""
    fits = profiles.env_step.tolist()
    left, right = st.columns([3, 2])
    with left, st.container(border=True, height="stretch"):
        st.markdown("**Every fit**: weight by age, newest on top, and the returns")
        mode, loop = session.mode(), readers.loop(run)

        def drawn() -> Drawn:
            figure = weight_map(profiles, mode, HEIGHT, x=steps_in_words([run.env]))
            return Drawn.of(with_returns(figure, widgets.curve(loop, "eval/return")))

        version = run.version("profiles"), loop.version("metrics")
        figure = _MAPS.get((run.path, mode), drawn, version)
        label = "weight of each part of the buffer at every fit, and the returns below"
        chart(figure, "weight map", label, partial(_go_to, fits), follow=Follow(cursor=True))
        if run.small_copy and len(fits) >= FITS:
            st.caption(f"An example keeps {FITS} fits at most, spread over the run.")
    with right, st.container(border=True, height="stretch"):
        st.markdown("**This fit**; dashed: every transition counts the same")
        top = float(np.nanmax(profiles.bins))  # of all fits, so that the axis stands still
        bins = profiles.bins[fits.index(fit)]
        figure = weight_profile(bins, run.learner, HEIGHT, top=top, keep=run.run_id)
        finite = np.maximum(np.nan_to_num(profiles.bins), FLOOR)  # JSON has no NaN
        at_fits = np.where(finite < 1, finite.round(4), finite.round(2)).tolist()
        follow = Follow(steps=fits, traces={0: at_fits})
        chart(figure, "profile", "mean weight, oldest to newest transitions", follow=follow)


def _elsewhere(run: RunReader, step: int) -> None:
    """What other pages, and the other part of this one, make of these weights."""
    row = st.container(horizontal=True, vertical_alignment="center")
    kept = [at for at in run.policy_steps() if at <= step]
    if kept:
        row.button(
            f"Every learner on the buffer of step {kept[-1]:,}", key="every learner",
            icon=":material/scale:", on_click=_open_learners, args=(run, kept[-1]),
        )  # fmt: skip
    with row:
        widgets.link_to("replays", "Weights of several runs, side by side", part="Side by side")


def _open_learners(run: RunReader, step: int) -> None:
    state = st.session_state
    state["part"], state["run"], state["at"] = LEARNERS_ON_IT, [run.run_id], step
    of_step = [one for one in weighings.every(run, buffer.length(run)) if one.step == step]
    if of_step:
        state["weighed"] = of_step[0].name


def _go_to(fits: list[int], point: Point) -> None:
    """Show the clicked fit; for a clicked return the last fit before it."""
    timeline.go_to(at_or_before(fits, int(point.x)))


def _even(run: RunReader, profiles: Profiles, chosen: int) -> None:
    """Say why the weights of a learner that weighs are all the same."""
    uniform = run.learner in LEARNERS and LEARNERS[run.learner].uniform
    if uniform or profiles.ess[chosen] <= EVEN:
        return
    step = int(profiles.env_step[chosen])
    noticed = {(notice.get("env_step"), notice.get("code")) for notice in readers.notices(run)}
    if (step, DEGENERATE[0]) in noticed:
        reason = "its weights could not be used"
    elif (profiles.ess[:chosen] <= EVEN).any():
        reason = "although it had weighed before"
    else:
        reason = "its warm-up, before it weighs"
    st.caption(f"At step {step:,} all transitions count the same: {reason}.")


def _numbers(run: RunReader, profiles: Profiles) -> None:
    fits = profiles.env_step.tolist()
    newest, ess, zeros = (
        [readable.percent(float(value)) for value in values]
        for values in (newest_share(profiles), profiles.ess, profiles.zeros)
    )
    readout.readout(
        "numbers",
        fits,
        [
            Number("fit at step", [f"{fit:,}" for fit in fits]),
            Number("transitions", [f"{count:,}" for count in profiles.count]),
            Number(
                "weight on the newest fifth", newest,
                "share of the whole weight on the newest fifth of the buffer; 20 % if all count "
                "the same",
            ),
            Number(
                "effective sample", ess,
                "(sum w)² / sum w², as a share of the buffer: 100 % if all count the same",
            ),
            Number("weight zero", zeros, "share of the transitions whose weight is zero"),
            *exam.numbers(run, fits),
        ],
    )  # fmt: skip
