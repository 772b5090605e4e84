"""Attention: which rows of the replay buffer get weight, at every fit, and what they are."""

from collections.abc import Mapping, Sequence
from functools import partial

import numpy as np
import streamlit as st

from app import session, text
from app.data import readers, road, weighings
from app.data.cache import cached
from app.data.run_names import distinct_names, full_names
from app.data.weighings import Dataset
from app.figures.road import cells, road_map
from app.figures.weights import FLOOR, over_fits, weight_profile
from app.parts import address, timeline, widgets
from app.parts.map import SELECTOR
from app.parts.plot import FigureJson, Follow, Point, chart
from app.parts.scope import Scope
from app.scenes.control import RoadChoice
from app.theme import Mode
from app.views.attention import in_buffer, learners
from tom.analysis.answer import ROAD_METRICS, newest_share
from tom.analysis.curves import curve_points
from tom.analysis.exams import at_fit
from tom.analysis.weight_readers import weight_readers
from tom.envs import ROAD
from tom.exams import informative
from tom.learners import LEARNERS, learner_label
from tom.learners.base import DEGENERATE
from tom.metrics import describe
from tom.readable import Settings, percent, short
from tom.record.decode import Profiles
from tom.record.reader import RunReader, at_or_before
from tom.record.thin import FITS

ONE, LEARNERS_ON_IT = "One learner's weights", "Every learner on one buffer"
EVEN = 0.9999
"""effective sample size (share) from which weights count as uniform"""
HEIGHT = 270
NOISE = "exam/footprint_noise"
EXAMS = {
    "footprint": "exam/footprint",
    "its noise": NOISE,
    "error, one step": "exam/error",
    "error, five steps": "exam/rollout_error",
}
ROAD_HEIGHT, SMALL_HEIGHT = 620, 360
MOST_BESIDE = 3
ROAD_NUMBERS = {
    "weight on the road": "weights/road_share",
    "road : rocks, random data": "weights/road_ratio",
    "error, expert data": "model/error_expert",
    "error, road": "model/error_road",
    "error, rocks": "model/error_rocks",
    "planner return": "planner/return",
    "policy return": "eval/return",
}


def page(scope: Scope) -> None:
    """A run's weights over its fits and in its buffer, or those of all learners for one buffer."""
    if address.choose_part([ONE, LEARNERS_ON_IT]) == LEARNERS_ON_IT:
        learners.draw(scope)
        return
    run = in_buffer.choose(
        scope, lambda: st.columns([1, 2])[0], lambda run: bool(weight_readers(run)),
        widgets.interest_key,
    )  # fmt: skip
    scope.show_missing(run, "weights")
    if isinstance(run, Dataset):
        in_buffer.draw(run, 0)
        widgets.show_problems(run)
        return
    asked = next((one for one in scope.runs if one.run_id == scope.chosen_id), None)
    if run is None or (asked and run.run_id != scope.chosen_id):
        which = "The chosen run has not" if asked else "No run here has"
        words = f"{which} fitted a model yet: weights come with the first fit."
        if asked and not asked.fits_model:
            words = f"A recording of SAC fits no model. *{LEARNERS_ON_IT}* weighs its rows."
        st.info(words)
        return
    found = weight_readers(run) or {run.learner: run}  # by its own weights, or by live ones
    weigher = next(iter(found))
    if len(found) > 1:
        weigher = address.choose_one(
            st.segmented_control, "Weights by", list(found), "by", weigher, learner_label,
            required=True,
        )  # fmt: skip
    run = found[weigher]
    if run.home != run.path:  # no card shows it
        for words in filter(None, (*run.status.warnings, run.status.reason)):
            st.caption(text.markdown(words))
    profiles = readers.profiles(run)
    fits, evaluations = profiles.env_step.tolist(), run.evaluation_steps()
    if fits:
        step = timeline.chosen_step(sorted({*fits, *evaluations}))
        fit = at_or_before(fits, step)
        name = text.markdown(full_names(scope.runs)[run.run_id])
        st.header(f"Which data {name} pays attention to", anchor=False)
        above = st.container()
        in_buffer.draw(run, fit)  # first, because the browser takes longest for it
        with above:
            if run.env == ROAD:
                _road(scope, run, step)
            else:
                _numbers(run, profiles)
                _explain_even_weights(run, profiles, fits.index(fit))
                _exam(run, fit)
                _over_time(run, profiles, fit)
        if run.env != ROAD:
            _links(run, step)
        timeline.draw(fits, evaluations, step)
    else:
        st.warning("The weight profiles of this run cannot be read.")
    widgets.show_problems(run)


def _numbers(run: RunReader, profiles: Profiles) -> None:
    """What was measured of the weights of each fit, and by its exam."""
    fits = profiles.env_step.tolist()

    def shares(values: np.ndarray) -> list[str]:
        return [percent(float(value)) for value in values]

    frame = readers.metrics(run)
    exams = frame.drop_duplicates("env_step", keep="last").set_index("env_step").reindex(fits)
    if NOISE in exams:  # a footprint below its noise says nothing
        exams["exam/footprint"] = exams["exam/footprint"].where(informative(exams[NOISE]))
    timeline.numbers(
        fits,
        [
            ("fit at step", [f"{fit:,}" for fit in fits], ""),
            ("transitions", [f"{count:,}" for count in profiles.count], ""),
            (
                "weight on the newest fifth", shares(newest_share(profiles)),
                "share of all weight on the newest fifth of the buffer; 20 % if all transitions "
                "count the same",
            ),
            (
                "effective sample", shares(profiles.ess),
                "(sum w)² / sum w², as a share of the buffer: 100 % if all count the same",
            ),
            (
                "weight zero", shares(profiles.zeros),
                "share of the transitions whose weight is zero",
            ),
            *(
                (name, [short(value) for value in exams[path]], describe(path))
                for name, path in EXAMS.items()
                if path in exams and np.isfinite(exams[path].to_numpy(np.float64)).any()
            ),
        ],
    )  # fmt: skip


def _explain_even_weights(run: RunReader, profiles: Profiles, chosen: int) -> None:
    """Say why the weights of a learner that weighs are all the same."""
    if widgets.has_uniform_learner(run) or profiles.ess[chosen] <= EVEN:
        return
    step = int(profiles.env_step[chosen])
    noticed = {(notice.get("env_step"), notice.get("code")) for notice in readers.notices(run)}
    if (step, DEGENERATE[0]) in noticed:
        reason = "the learner's weights could not be used"
    elif (profiles.ess[:chosen] <= EVEN).any():
        reason = "although the learner had weighed before"
    else:
        reason = "the learner is still warming up"
    st.caption(f"At step {step:,} all transitions count the same: {reason}.")


def _exam(run: RunReader, fit: int) -> None:
    """What the exam of a fit means, or why it has none."""
    metrics = at_fit(readers.metrics(run), fit)
    if metrics:
        st.caption(
            text.markdown(
                "This fit's exam is the steps that its policy took next, which it had not seen. "
                f"{footprint_sentence(metrics)} "
                f"{difference_from_recorded(run.learner, run.settings)}"
            )
        )
    else:
        st.caption(
            "This fit has no exam, or none yet: an exam ends with the next fit. Weights handed in "
            "by your own loop, and runs recorded by versions before exams, have none."
        )


def difference_from_recorded(learner: str, settings: Settings) -> str:
    """How the weights of an exam, the fit's, differ from those that were recorded; else empty."""
    share = float(settings.get("model.uniform_share", 0))
    if share == 1:
        return (
            "Its model was fitted, and is examined, with every transition counting the same "
            "(model.uniform_share 1); the weights above only choose where rollouts start."
        )
    changes = [f"mixed with uniform weights (share {share:g})"] if share else []
    if learner in LEARNERS and LEARNERS[learner].clipped and "model.weight_clip" in settings:
        changes.insert(0, f"clipped at {float(settings['model.weight_clip']):g}")
    if not changes:
        return ""
    return f"The model was fitted, and is examined, with these weights {' and '.join(changes)}."


def footprint_sentence(metrics: Mapping[str, float]) -> str:
    """Whether the weights moved the buffer closer to the policy's transitions, beyond noise."""
    uniform, footprint, noise = (
        metrics.get(f"exam/{name}")
        for name in ("footprint_uniform", "footprint", "footprint_noise")
    )
    if uniform is None:
        return "Too few steps to tell where the weights should lie."
    if footprint is None or noise is None or not informative(noise):
        return (
            "The footprint cannot be measured at this fit: the unweighted buffer is no farther "
            "from these steps than their two halves are from each other."
        )
    if footprint < 1 - abs(noise):
        return (
            f"The weights bring the buffer nearer to what the policy did: {footprint:.2f} of its "
            "unweighted distance is left."
        )
    if footprint > 1 + abs(noise):
        return (
            f"The weights take the buffer away from what the policy did: it is {footprint:.2f} "
            "times as far as without weights."
        )
    return "Weighted or not, the buffer is equally near to what the policy did, but for noise."


def _over_time(run: RunReader, profiles: Profiles, fit: int) -> None:
    """The weights of all fits by age, with the returns, and the profile of one."""
    fits = profiles.env_step.tolist()
    left, right = st.columns([3, 2])
    with left, st.container(border=True, height="stretch"):
        st.markdown("**Every fit**: weight by age, newest on top, and the returns")
        loop = readers.folder_reader(run.home)  # of live weights: whose returns these are
        figure = _every_fit(run, loop, session.mode())
        label = "weight of each part of the buffer at every fit, and the returns below"
        to_fit = partial(_go_to, fits)
        chart(figure, "weight map", label, to_fit, follow=Follow(cursor=True), after=SELECTOR)
        if run.small_copy and len(fits) >= FITS:
            st.caption(f"An example keeps {FITS} fits at most, spread over the run.")
    with right, st.container(border=True, height="stretch"):
        st.markdown("**This fit**; dashed: every transition counts the same")
        finite = np.nan_to_num(profiles.bins)  # JSON has no NaN
        weights = np.where(finite < 1, finite.round(6), finite.round(2))
        drawn = np.maximum(weights, FLOOR).tolist()
        frames = zip(fits, weights.tolist(), drawn, strict=True)
        follow = Follow(trace={at: {"customdata": own, "y": y} for at, own, y in frames})
        label = "mean weight, oldest to newest transitions"
        chart(_one_fit(run, fit), "profile", label, follow=follow, after=SELECTOR)


@cached("profiles", "metrics")
def _every_fit(run: RunReader, loop: RunReader, mode: Mode) -> FigureJson:
    returns = widgets.curve(loop, "eval/return")
    return FigureJson.of(over_fits([("", returns, readers.profiles(run))], mode, HEIGHT))


@cached("profiles")
def _one_fit(run: RunReader, fit: int) -> FigureJson:
    profiles = readers.profiles(run)
    top = float(np.nanmax(profiles.bins))  # of all fits, so that the axis stands still
    bins = profiles.bins[profiles.env_step.tolist().index(fit)]
    return FigureJson.of(weight_profile(bins, run.learner, HEIGHT, top=top, keep=run.run_id))


def _go_to(fits: list[int], point: Point) -> None:
    """Show the clicked fit; for a clicked return the last fit before it."""
    timeline.go_to(at_or_before(fits, int(point.x)))


def _links(run: RunReader, step: int) -> None:
    """What other pages, and the other part of this one, make of these weights."""
    kept = [at for at in run.policy_steps() if at <= step]

    def open_learners() -> None:
        state = st.session_state
        state["part"], state["run"], state["at"] = LEARNERS_ON_IT, [run.run_id], kept[-1]
        for one in weighings.all_of_run(run):
            if one.step == kept[-1]:
                state["weighed"] = one.name
                break

    with st.container(horizontal=True, vertical_alignment="center"):
        if kept:
            st.button(
                f"Every learner on the buffer of step {kept[-1]:,}", key="every learner",
                icon=":material/scale:", on_click=open_learners,
            )  # fmt: skip
        widgets.link_to("replays", "Weights of several runs, side by side", part="Side by side")


def _road(scope: Scope, run: RunReader, step: int) -> None:
    """A run and a fit, its 3D scene and map, and the numbers of every learner."""
    shown = [one for one in scope.runs if one.env == ROAD and road.steps(one)]
    if run not in shown:
        st.info("This road-and-rocks run has recorded no weights yet.", icon=":material/add_road:")
        return
    st.caption(
        "A car must follow the road; on the rocks, steering is turned, differently in every cell. "
        "A linear model cannot be right everywhere; the weights decide where it is right."
    )
    others = {one.run_id: one for one in shown if one.run_id != run.run_id}
    beside = address.choose_many(
        "Side by side with", list(others), "beside", full_names(shown).__getitem__,
        max_selections=MOST_BESIDE, placeholder="no other run",
    )  # fmt: skip
    if road.fit(run, step) is None:
        st.warning("This run's map cannot be read.")
        return
    _road_numbers(run)
    runs = [run, *(others[run_id] for run_id in beside)]
    choice = RoadChoice(tuple(str(each.path) for each in runs), step)
    names = distinct_names(runs)
    if len(runs) > 1:
        widgets.show_scene(choice, ROAD_HEIGHT)
        for column, each in zip(st.columns(len(runs)), runs, strict=True):
            with column, st.container(border=True):
                _flat_map(each, step, SMALL_HEIGHT, names[each.run_id])
    else:
        left, right = st.columns([5, 4])
        with left:
            widgets.show_scene(choice, ROAD_HEIGHT)
        with right:
            _flat_map(run, step, ROAD_HEIGHT)
    _export(runs, list(names.values()))
    widgets.link_to("curves", "All runs of this task, side by side")
    for each in runs[1:]:
        widgets.show_problems(each)


def _flat_map(run: RunReader, step: int, height: int, name: str = "") -> None:
    """The map, whose cells follow the timeline in the browser."""
    picture = road.fit(run, step)
    if picture is None:
        st.caption(f"The map of {text.markdown(run.run_id)} cannot be read.")
        return
    if name:
        st.markdown(f"**{text.markdown(name)}**, step {picture.step:,}")
    of_step = {at: cells(found) for at in road.steps(run) if (found := road.picture(run, at))}
    chart(
        road_map(picture, session.mode(), height), f"road map {run.run_id}",
        "mean weight over the map, with road and trajectories",
        follow=Follow(trace=of_step),
    )  # fmt: skip


def _export(runs: Sequence[RunReader], names: list[str]) -> None:
    """A button that exports the runs' 3D scene with all fits as one HTML file."""
    mode = session.mode()

    def make_page() -> str:
        from app.scenes.road import as_html  # here: viser and trimesh take 0.7 s to import

        steps = sorted({step for run in runs for step in road.steps(run)})
        fits = [[road.fit(run, step) for run in runs] for step in steps]
        whole = [[one for one in fit if one is not None] for fit in fits if all(fit)]
        return as_html(whole, mode, names)

    st.download_button(
        "Share the scene as one HTML file", make_page, "road-and-rocks.html", "text/html",
        icon=":material/ios_share:", on_click="ignore",
        help="opens in any browser and needs no other file; plays every fit in turn, with the "
        "cars; some MB",
    )  # fmt: skip


def _road_numbers(run: RunReader) -> None:
    """What was last measured by each of the run's fits."""
    frame, steps = readers.metrics(run), road.steps(run)
    numbers = []
    for label, metric in ROAD_NUMBERS.items():
        at, values = curve_points(frame, metric)
        if metric == ROAD_METRICS[1]:
            weighed = frame.reindex(columns=["env_step", *ROAD_METRICS]).dropna(
                subset=ROAD_METRICS[0]
            )
            at, values = weighed["env_step"].to_numpy(), weighed[metric].to_numpy()
        last = [float(values[at <= step][-1]) if (at <= step).any() else np.nan for step in steps]
        shown = percent if metric == "weights/road_share" else short
        numbers.append((label, [shown(value) for value in last], describe(metric)))
    timeline.numbers(steps, numbers)
