"""Attention: which part of the replay buffer gets weight, at every fit and in every region."""

from functools import partial

import numpy as np
import streamlit as st
from numpy.typing import NDArray
from streamlit.delta_generator import DeltaGenerator

from app import session, text
from app.data import buffer, readers, weighings
from app.data.answer import newest_share
from app.data.buffer import Floats, against
from app.data.called import names, told_apart
from app.figures.base import steps_in_words
from app.figures.regions import weights_against
from app.figures.weights import (
    FLOOR,
    effective_sample,
    on_log_axis,
    profile_lines,
    weight_map,
    weight_profile,
    with_returns,
)
from app.parts import address, empty, readout, timeline, widgets
from app.parts.plot import Follow, Point, chart
from app.parts.readout import Number
from app.parts.scope import Scope
from app.views.answer.model_error import in_turn
from app.views.attention import exam, in_buffer, learners, road, why
from tom import readable
from tom.envs import ROAD
from tom.learners import LEARNERS
from tom.learners.base import DEGENERATE
from tom.record.decode import Profiles
from tom.record.reader import RunReader, at_or_before
from tom.record.thin import FITS

TIME, BUFFER, LEARNERS_ON_IT = "Over time", "In the buffer", "Every learner on one buffer"
EVEN = 0.9999
"""effective sample size (share) from which weights count as uniform"""
RELATIVE, LINEAR = "against uniform", "as they are"
TOGETHER = 6
"""maximum number of runs whose last fits share an axis"""
AGAINST = (
    "Solid: mean weight of 30 equal groups of transitions. Dotted: nine of ten transitions of a "
    "group weigh less. Dashed: all count the same. Model error: root mean square over the "
    "dimensions, each in standard deviations of its change in a step."
)


def page(scope: Scope) -> None:
    """A run's weights over all its fits, in its buffer, and beside those of other learners."""
    row = st.container(horizontal=True, vertical_alignment="center", gap="small")
    part = address.choose_one(
        row.segmented_control, "Part", [TIME, BUFFER, LEARNERS_ON_IT], "part", TIME,
        required=True, label_visibility="collapsed",
    )  # fmt: skip
    if part == LEARNERS_ON_IT:
        learners.draw(scope)
    elif part == BUFFER:
        in_buffer.draw(scope)
    else:
        _over_time(scope, row)


def _over_time(scope: Scope, row: DeltaGenerator) -> None:
    run = scope.one(readers.has_profiles, widgets.telling)
    if run is None:
        st.info("No run here has fitted a model yet: weights come with the first fit.")
        return
    profiles = readers.profiles(run)
    if not len(profiles.env_step):
        st.warning("The weight profiles of this run cannot be read.")
        widgets.show_problems(run)
        return
    if run.env == ROAD:
        road.draw(scope, run)
        return
    scale = address.choose_one(
        row.segmented_control, "Colours", [RELATIVE, LINEAR], "scale", RELATIVE, required=True,
        label_visibility="collapsed",
    )  # fmt: skip
    fits, evaluations = profiles.env_step.tolist(), run.evaluation_steps()
    step = timeline.chosen(sorted({*fits, *evaluations}))
    fit = at_or_before(fits, step)
    called = text.markdown(names(scope.runs)[run.run_id])
    st.header(f"Which data {called} pays attention to", anchor=False)
    _numbers(run, profiles, fits)
    _offer_learners(run, fit)
    _even(run, profiles, fits.index(fit))
    _figures(run, profiles, fits.index(fit), relative=scale == RELATIVE)
    exam.of_fit(run, fit)
    _against(run, fit)
    _last_fits(scope, run)
    widgets.show_problems(run)
    timeline.draw(fits, evaluations, step)


def _offer_learners(run: RunReader, fit: int) -> None:
    """A way to what every learner makes of the buffer of the last fit whose policy was kept."""
    kept = [step for step in run.policy_steps() if step <= fit]
    if not kept:
        return

    def go() -> None:
        st.session_state["part"], st.session_state["run"] = LEARNERS_ON_IT, [run.run_id]
        st.session_state["at"] = kept[-1]
        for weighing in weighings.of_run(run, buffer.length(run)):
            if weighing.step == kept[-1]:
                st.session_state["weighed"] = weighing.name
                break

    st.button(
        f"Every learner on the buffer of step {kept[-1]:,}", key="every learner", on_click=go,
        icon=":material/scale:",
    )  # fmt: skip


def _figures(run: RunReader, profiles: Profiles, chosen: int, *, relative: bool) -> None:
    """The map of all fits with the returns, the profile of one, and what is left of the buffer."""
    x, fits = steps_in_words([run.env]), profiles.env_step.tolist()
    go_to = partial(_go_to, fits)
    left, right = st.columns([3, 2])
    with left, st.container(border=True):
        st.markdown("**Every fit**: weight by age, newest on top, and the returns")
        figure = weight_map(profiles, session.mode(), 440, relative=relative, x=x)
        figure = with_returns(figure, widgets.curve(run, "eval/return"))
        label = "weight of each part of the buffer at every fit, and the returns below"
        chart(figure, "weight map", label, go_to, follow=Follow(cursor=True))
        if run.small_copy and len(fits) >= FITS:
            st.caption(f"An example keeps {FITS} fits at most, spread over the run.")
    with right, st.container(border=True):
        st.markdown("**The fit at the timeline's step**; dashed: every transition counts the same")
        top = float(np.nanmax(profiles.bins))  # of all fits, so that the axis stands still
        figure = weight_profile(profiles.bins[chosen], run.learner, 235, keep=run.run_id)
        figure = on_log_axis(figure, top)
        finite = np.maximum(np.nan_to_num(profiles.bins), FLOOR)  # JSON has no NaN
        bins = [[float(f"{value:.3g}") for value in row] for row in finite]
        follow = Follow(steps=fits, traces={0: bins})
        chart(figure, "profile", "mean weight, oldest to newest transitions", follow=follow)
        st.markdown("**How much of the buffer is left**")
        figure = effective_sample(profiles, run.learner, 190, x, keep=run.run_id)
        label = "effective sample size and share of zero weights"
        chart(figure, "effective sample", label, go_to, follow=Follow(cursor=True))


def _against(run: RunReader, step: int) -> None:
    """Weight against age, episode return, model error and policy version, if stored."""
    kept = run.snapshot_steps()
    if not kept:
        return
    fit = at_or_before(kept, step)
    rows = buffer.rows(run, fit)
    if rows is None:
        if not empty.left_out(run, "buffer"):
            st.caption("The replay buffer of this run cannot be read.")
        return
    st.markdown(f"**What the weights of step {fit:,} go with**", help=AGAINST)
    if fit != step:
        which = "the last of them by then" if fit < step else "the first of them, a later one"
        st.caption(f"Single weights are kept of a dozen fits at most; this is {which}.")
    errors = buffer.model_errors(run, fit)
    panels: list[tuple[str, NDArray, Floats]] = [
        ("position in the buffer, % (0: oldest)", rows.age, rows.weight),
        ("return of the episode", rows.episode_return, rows.weight),
        ("policy version (0: exploration)", rows.version, rows.weight),
    ]
    if not isinstance(errors, str):
        index, error, at = errors
        panels.append((f"error of the model of step {at:,}", error, rows.weight[index]))
    for column, (name, quantity, weight) in zip(st.columns(len(panels)), panels, strict=True):
        with column, st.container(border=True):
            groups = against(quantity, weight)
            figure = weights_against(groups, run.learner, name, 230, keep=run.run_id)
            chart(figure, f"against {name.split(' of the model')[0]}", f"weight against {name}")
    if isinstance(errors, str):
        st.caption(f"No model error: {text.markdown(errors)}.")
    why.section(run, rows)
    empty.left_out(run, "other snapshots")


def _last_fits(scope: Scope, run: RunReader) -> None:
    """The profiles of the last fits of the run and of shown runs of its task, on one axis."""
    others = [one for one in scope.shown if one.env == run.env and one.run_id != run.run_id]
    together = in_turn(run, [run, *(one for one in others if readers.has_profiles(one))])
    together = together[:TOGETHER]
    if len(together) < 2:
        return
    called = told_apart(together)
    of_runs = [(one, readers.profiles(one).bins) for one in together]
    last = [(called[one.run_id], one.learner, bins[-1]) for one, bins in of_runs if len(bins)]
    with st.container(border=True):
        head = st.container(horizontal=True, vertical_alignment="center")
        head.markdown("**The last fits of the shown runs**, each of its own buffer")
        log = widgets.pick_log(head, [bins for *_, bins in last])
        figure = profile_lines(last, 300, log=log, keep=run.run_id)
        chart(figure, "last fits", "mean weight, oldest to newest, at the last fit of each run")


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


def _numbers(run: RunReader, profiles: Profiles, fits: list[int]) -> None:
    percents = [
        [readable.percent(float(value)) for value in values]
        for values in (newest_share(profiles), profiles.ess, profiles.zeros)
    ]
    readout.readout(
        "numbers",
        fits,
        [
            Number("fit at step", [f"{fit:,}" for fit in fits]),
            Number("transitions", [f"{count:,}" for count in profiles.count]),
            Number(
                "weight on the newest fifth", percents[0],
                "share of the whole weight on the newest fifth of the buffer; 20 % if all count "
                "the same",
            ),
            Number(
                "effective sample", percents[1],
                "(sum w)² / sum w², as a share of the buffer: 100 % if all count the same",
            ),
            Number("weight zero", percents[2], "share of the transitions whose weight is zero"),
        ],
    )  # fmt: skip
