"""Weights: which part of the replay buffer a learner weighs most, at every fit."""

from functools import partial

import numpy as np
import streamlit as st
from numpy.typing import NDArray

from app import session, text
from app.data import buffer, readers
from app.data.buffer import Floats, against
from app.figures.base import steps_in_words
from app.figures.regions import weights_against
from app.figures.weights import effective_sample, weight_map, weight_profile, with_returns
from app.parts import address, empty, why, widgets
from app.parts.plot import Point, chart
from app.theme import learner_label
from app.views.weights import exam, play, same_buffer
from tom import readable
from tom.data.sampling import bin_means
from tom.envs import ROAD
from tom.learners import LEARNERS
from tom.learners.base import DEGENERATE
from tom.record.decode import Profiles
from tom.record.reader import RunReader, at_or_before
from tom.record.thin import FITS

EVEN = 0.9999
"""effective sample size (share) from which weights count as uniform"""
RELATIVE = "against uniform"
LINEAR = "as they are"
AGAINST = (
    "Solid: mean weight of 30 equal groups of transitions. Dotted: nine of ten transitions of a "
    "group weigh less. Dashed: all count the same. Model error: root mean square over the "
    "dimensions, each in standard deviations of its change in a step."
)


def page() -> None:
    """The step x bin map, the profile at a step, its exam and the effective sample size."""
    listing = readers.listing(session.links().store)
    with_weights = [run for run in listing.runs if readers.has_profiles(run)]
    # Offline weights hardly change and have their own page.
    with_weights.sort(key=lambda run: run.env == ROAD)
    if not with_weights:
        st.info("No run has fitted a model yet: weights appear after the first fit.")
        return
    top = st.columns([5, 3, 1], vertical_alignment="bottom")
    with top[0]:
        run = widgets.pick_run(with_weights)
    scale = top[1].segmented_control(
        "Colours",
        [RELATIVE, LINEAR],
        default=RELATIVE,
        required=True,
        key="scale",
        bind="query-params",
    )
    profiles = readers.profiles(run)
    if not len(profiles.env_step):
        st.warning("The weight profiles of this run cannot be read.")
        widgets.show_problems(run)
        return
    with top[2]:
        plays = play.button(profiles.env_step.tolist())
    steps = profiles.env_step.tolist()
    step = address.choose_step("Fit at step", steps, steps[-1], of=run.env)
    chosen = steps.index(step)
    _numbers(run, profiles, chosen)
    _figures(run, profiles, chosen, relative=scale == RELATIVE)
    if plays:  # the rest of the page would slow it down
        address.keep("step", st.query_params.get_all("step"))  # else each fit is one more Back
        play.go_on(profiles.env_step.tolist(), chosen)
        return
    exam.of_fit(run, step)
    _effective_sample(run, profiles, chosen)
    same_buffer.at_fit(run, step)
    _against(run, step)
    widgets.show_problems(run)


def _figures(run: RunReader, profiles: Profiles, chosen: int, *, relative: bool) -> None:
    """The map of all fits, and the profile of the chosen one."""
    x = steps_in_words([run.env])
    left, right = st.columns([3, 2])
    with left, st.container(border=True):
        st.markdown("**Every fit**: click one to look at it")
        figure = weight_map(profiles, chosen, session.mode(), 440, relative=relative, x=x)
        step = int(profiles.env_step[chosen])
        figure = with_returns(figure, widgets.curve(run, "eval/return"), step)
        words = "weight of each part of the buffer at every fit, and the returns below"
        chart(figure, "weight map", words, partial(_choose, profiles.env_step.tolist()))
        if run.small_copy and len(profiles.env_step) >= FITS:
            st.caption(f"A small copy keeps {FITS} fits at most, spread over the run.")
    with right, st.container(border=True):
        step = profiles.env_step[chosen]
        st.markdown(f"**The fit at step {step:,}**: dashed: every transition counts the same")
        top = float(np.nanmax(profiles.bins))
        figure = weight_profile(profiles.bins[chosen], run.learner, 440, top, keep=run.run_id)
        chart(figure, "profile", "mean weight, oldest to newest transitions")


def _effective_sample(run: RunReader, profiles: Profiles, chosen: int) -> None:
    with st.container(border=True):
        st.markdown("**How much of the buffer is left**")
        x = steps_in_words([run.env])
        figure = effective_sample(profiles, run.learner, chosen, 250, x, keep=run.run_id)
        words = "effective sample size and share of zero weights"
        chart(figure, "effective sample", words, partial(_choose, profiles.env_step.tolist()))


def _against(run: RunReader, step: int) -> None:
    """Weight against age, episode return, model error and policy version, if stored."""
    kept = run.snapshot_steps()
    if not kept:
        return
    if step not in kept:
        _pick_kept(kept)
        return
    fit = step
    rows = buffer.rows(run, fit)
    if rows is None:
        if not empty.left_out(run, "buffer"):
            st.caption("The replay buffer of this run cannot be read.")
        return
    st.markdown(f"**What the weights of step {fit:,} go with**", help=AGAINST)
    errors = buffer.model_errors(run, fit)
    panels: list[tuple[str, NDArray, Floats]] = [
        ("position in the buffer, % (0: oldest)", rows.age, rows.weight)
    ]
    if run.env != ROAD:
        panels.append(("return of the episode", rows.episode_return, rows.weight))
        panels.append(("policy version (0: exploration)", rows.version, rows.weight))
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


def _pick_kept(kept: list[int]) -> None:
    """Offer the fits whose single weights are stored; those of another fit would mislead."""

    def go() -> None:
        st.session_state["step"] = st.session_state["kept fit"]

    st.selectbox(
        "Single weights, and what they go with, were kept of the fits at steps",
        kept, index=None, key="kept fit", on_change=go, format_func=lambda at: f"{at:,}",
        placeholder="go to one of them",
    )  # fmt: skip


def _choose(steps: list[int], point: Point) -> None:
    """Choose the clicked fit; for a clicked return the last fit before it."""
    st.session_state["step"] = at_or_before(steps, int(point.x))


def newest_fifth(bins: Floats) -> float:
    """The share of the weight on the newest fifth of the buffer, for any number of bins."""
    fifths = bin_means(bins, 5)
    return float(fifths[-1] / fifths.sum()) if fifths.sum() > 0 else float("nan")


def _why_even(run: RunReader, profiles: Profiles, chosen: int) -> str:
    """Why the weights of a learner that weighs are all the same."""
    name, step = text.markdown(learner_label(run.learner)), int(profiles.env_step[chosen])
    said = {(notice.get("env_step"), notice.get("kind")) for notice in readers.notices(run)}
    if (step, DEGENERATE[0]) in said:
        return f"{name}'s weights were unusable, so all transitions counted the same"
    if (profiles.ess[:chosen] <= EVEN).any():
        return f"{name} counted all transitions the same, although it had weighed before"
    return f"{name} still counted all transitions the same: its warm-up, before it weighs"


def _numbers(run: RunReader, profiles: Profiles, chosen: int) -> None:
    bins = profiles.bins[chosen]
    share = newest_fifth(bins)
    columns = st.columns(5)
    columns[0].metric("learner", text.markdown(learner_label(run.learner)))
    if profiles.ess[chosen] > EVEN and not (
        run.learner in LEARNERS and LEARNERS[run.learner].uniform
    ):
        st.caption(f"At this fit {_why_even(run, profiles, chosen)}.")
    columns[1].metric("transitions", f"{profiles.count[chosen]:,}")
    columns[2].metric(
        "effective sample",
        readable.percent(float(profiles.ess[chosen])),
        help="(sum w)² / sum w², as a share of the buffer: 100 % when all count the same",
    )
    columns[3].metric("weight zero", readable.percent(float(profiles.zeros[chosen])))
    columns[4].metric(
        "on the newest fifth",
        readable.percent(share),
        help="share of the whole weight that lies on the newest fifth of the buffer; 20 % when "
        "all count the same",
    )
