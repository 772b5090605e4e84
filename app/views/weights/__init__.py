"""Weights: which part of the replay buffer a learner looks at, fit by fit."""

import streamlit as st
from numpy.typing import NDArray

from app import session, text
from app.data import buffer_reader, pictures, readers
from app.data.buffer import Floats, against
from app.data.readers import RunInfo
from app.figures.base import steps_in_words
from app.figures.regions import weights_against
from app.figures.weights import effective_sample, weight_map, weight_profile
from app.parts import empty, widgets
from app.parts.plot import Point, chart
from app.theme import learner_label
from app.views.weights import exam, same_buffer
from tom.record.profiles import Profiles
from tom.record.reader import at_or_before

TITLE = "Weights"
ICON = ":material/gradient:"
PATH = "weights"

RELATIVE = "against uniform"
LINEAR = "as they are"
AGAINST = (
    "Solid: mean weight of 30 equal groups of transitions. Dotted: nine of ten transitions of a "
    "group weigh less. Dashed: all count the same. Model error: root mean square over the "
    "dimensions, each in standard deviations of its change in a step."
)


def page() -> None:
    """The step x bin map; beside it the profile at a step; below its exam and the sample left."""
    listing = readers.listing(session.links().store)
    with_weights = [run for run in listing.runs if readers.has_profiles(run)]
    # Offline weights hardly change and have a page of their own.
    with_weights.sort(key=lambda run: run.env == pictures.ENV)
    if not with_weights:
        st.info("No run has fitted a model yet: weights appear after the first fit.")
        return
    top = st.columns([3, 2], vertical_alignment="bottom")
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
    chosen = _chosen_fit(profiles)
    _numbers(run, profiles, chosen)
    step = int(profiles.env_step[chosen])
    _figures(run, profiles, chosen, relative=scale == RELATIVE)
    exam.of_fit(run, step)
    _effective_sample(run, profiles, chosen)
    same_buffer.at_fit(run, step)
    _against(run, step)
    widgets.show_problems(run)


def _figures(run: RunInfo, profiles: Profiles, chosen: int, *, relative: bool) -> None:
    """The map of all fits, and the profile of the chosen one."""
    x = steps_in_words([run.env])
    left, right = st.columns([3, 2])
    with left, st.container(border=True):
        st.markdown("**Every fit**: click one to look at it")
        figure = weight_map(profiles, chosen, session.mode(), 400, relative=relative, x=x)
        chart(figure, "weight map", "weight of each part of the buffer at every fit", _choose)
    with right, st.container(border=True):
        step = profiles.env_step[chosen]
        st.markdown(f"**The fit at step {step:,}**: dashed: every transition counts the same")
        figure = weight_profile(profiles.bins[chosen], run.learner, 400)
        chart(figure, "profile", "mean weight, oldest to newest transitions")


def _effective_sample(run: RunInfo, profiles: Profiles, chosen: int) -> None:
    with st.container(border=True):
        st.markdown("**How much of the buffer is left**")
        x = steps_in_words([run.env])
        figure = effective_sample(profiles, run.learner, chosen, 250, x)
        chart(
            figure, "effective sample", "effective sample size and share of zero weights", _choose
        )


def _against(run: RunInfo, step: int) -> None:
    """Weight against age, episode return, model error and policy version, where they are kept."""
    kept = buffer_reader.fits(run)
    if not kept:
        return
    fit = at_or_before(kept, step)
    rows = buffer_reader.rows(run, fit)
    if rows is None:
        if not empty.left_out(run, "buffer"):
            st.caption("The replay buffer of this run cannot be read.")
        return
    other = "" if fit == step else f" (every single weight was kept there, not at {step:,})"
    st.markdown(f"**What the weights of step {fit:,} go with**{other}", help=AGAINST)
    errors = buffer_reader.model_errors(run, fit)
    panels: list[tuple[str, NDArray, Floats]] = [
        ("position in the buffer, % (0: oldest)", rows.age, rows.weight)
    ]
    if run.env != pictures.ENV:
        panels.append(("return of the episode", rows.episode_return, rows.weight))
        panels.append(("policy version (0: exploration)", rows.version, rows.weight))
    if not isinstance(errors, str):
        index, error, at = errors
        panels.append((f"error of the model of step {at:,}", error, rows.weight[index]))
    for column, (name, quantity, weight) in zip(st.columns(len(panels)), panels, strict=True):
        with column, st.container(border=True):
            figure = weights_against(against(quantity, weight), run.learner, name, 230)
            chart(figure, f"against {name.split(' of the model')[0]}", f"weight against {name}")
    if isinstance(errors, str):
        st.caption(f"No model error: {text.markdown(errors)}.")
    empty.left_out(run, "other snapshots")


def _chosen_fit(profiles: Profiles) -> int:
    """The index of the fit in the address (`?step=`), the last one without."""
    steps = [int(step) for step in profiles.env_step]
    return steps.index(widgets.pick_step("Fit at step", steps))


def _choose(point: Point) -> None:
    st.session_state["step"] = int(point.x)


def _numbers(run: RunInfo, profiles: Profiles, chosen: int) -> None:
    bins = profiles.bins[chosen]
    fifth = max(len(bins) // 5, 1)
    share = bins[-fifth:].sum() / bins.sum() if bins.sum() > 0 else float("nan")
    columns = st.columns(5)
    columns[0].metric("learner", text.markdown(learner_label(run.learner)))
    columns[1].metric("transitions", f"{profiles.count[chosen]:,}")
    columns[2].metric(
        "effective sample",
        f"{100 * profiles.ess[chosen]:.1f} %",
        help="(sum w)² / sum w², as a share of the buffer: 100 % when all count the same",
    )
    columns[3].metric("weight zero", f"{100 * profiles.zeros[chosen]:.1f} %")
    columns[4].metric(
        "on the newest fifth",
        f"{text.number(100 * share)} %",
        help="share of the whole weight that lies on the newest fifth of the buffer; 20 % when "
        "all count the same",
    )
