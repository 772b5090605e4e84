"""Live: the running trainings, their progress and weights, and the Rerun viewer."""

import time
from collections.abc import Sequence

import numpy as np
import streamlit as st

from app import session, text
from app.data import readers
from app.data.called import names, told_apart
from app.figures.curves import run_curves
from app.figures.weights import profile_lines
from app.parts import again, pick, replay_link, rerun, widgets
from app.parts.cards import cards
from app.parts.plot import chart
from app.views.live import now, start
from tom.config import SAC_ALONE
from tom.metrics import describe
from tom.plugins import CHARTS
from tom.record.reader import RunReader

REFRESH_S, LOOK_S = 2, 5
"""seconds between two drawings while a run trains, and between two looks at which runs train"""
RECENT_S, RECENT = 900, 8
"""seconds for which a run that has ended stays on the page, and the number of those that do"""
MAIN_METRIC = "eval/return"
PREFERRED = (
    "weights/road_share",
    "model/error_expert",
    "model/error_road",
    "exam/footprint",
    "exam/error",
    "model/holdout_nll",
    "weights/ess",
    "critic/loss",
    "critic/q",
    "actor/entropy",
    "rollout/reward",
)


def page() -> None:
    """Live cards, curves, weights and the newest evaluation; Rerun on request."""
    runs = readers.listing(session.links().store).runs
    top = st.columns([3, 2], vertical_alignment="bottom")
    with top[0]:
        chosen = pick.many(
            "Runs", names(runs), "runs", placeholder="whatever is training (else the last runs)"
        )
    metrics = top[1].multiselect(
        "Curves",
        available(watched(runs, chosen)),
        key="curves",
        bind="query-params",
        placeholder="the usual ones",
        filter_mode="contains",
        select_all=False,
    )
    start.panel()
    alive = any(run.status.alive for run in runs)
    st.fragment(_followed, run_every=REFRESH_S if alive else None)(chosen, metrics)
    again.when_changed(_state, LOOK_S)
    icon, asked = ":material/view_in_ar:", rerun.CHOICE in st.query_params
    with st.expander("Rerun: everything that one run has recorded", icon=icon, expanded=asked):
        rerun.frame(runs)


def watched(runs: Sequence[RunReader], chosen: Sequence[str]) -> list[RunReader]:
    """The chosen runs; else those that train or have just ended; else each learner's newest run.

    The newest are those of one task: that of the newest run, of a recording of SAC only if no run
    has weights to show. Runs with a replay go before those without, and small copies count only in
    a store of nothing else.
    """
    picked = [run for run in runs if run.run_id in chosen]
    if not picked:
        ended = [run for run in runs if _just_ended(run)]
        picked = [run for run in runs if run.status.alive] + ended[:RECENT]
    if not picked and runs:
        runs = [run for run in runs if not run.small_copy] or runs
        last = next((run for run in runs if run.learner != SAC_ALONE), runs[0])
        of_task = [run for run in runs if run.env == last.env]
        for learner in dict.fromkeys(run.learner for run in of_task):
            mine = [run for run in of_task if run.learner == learner]
            picked.append(next((run for run in mine if run.evaluation_steps()), mine[0]))
    return sorted(picked, key=lambda run: (run.env, run.learner, run.seed, run.run_id))


def usual(runs: Sequence[RunReader]) -> list[str]:
    """The three default metrics: those that keep changing, the preferred ones first.

    Metrics of the machine's speed are left out; a run that explores has only those.
    """
    metrics = [name for name in available(runs) if not name.startswith("time/")]
    lines = [name for name in metrics if any(readers.points(r).get(name, 0) > 1 for r in runs)]
    return (lines or metrics)[:3]


def _just_ended(run: RunReader) -> bool:
    recent = time.time() - run.status.heartbeat < RECENT_S
    return recent and not run.status.alive and not run.small_copy


def available(runs: Sequence[RunReader]) -> list[str]:
    """Every metric that at least one of the runs has recorded, the preferred ones first."""
    metrics = {name for run in runs for name in readers.points(run)}
    metrics -= {"env_step", MAIN_METRIC}
    first = [name for name in PREFERRED if name in metrics]
    return first + sorted(metrics.difference(first))


def _state() -> object:
    """What decides which runs the page shows and whether it refreshes."""
    runs = readers.listing(session.links().store).runs
    known = [(run.run_id, run.status.shown, _just_ended(run)) for run in runs]
    return known, len(start.failed(runs))


def _followed(chosen: Sequence[str], metrics: Sequence[str]) -> None:
    runs = readers.listing(session.links().store).runs
    shown = watched(runs, chosen)
    alive = sum(run.status.alive for run in runs)
    st.caption(_headline(alive, shown, chosen))
    start.failures(runs)
    cards(shown, runs)
    for run in shown:
        widgets.show_problems(run)
    if not shown:
        return
    keep, called = " ".join(run.run_id for run in shown), names(runs)
    left, right = st.columns([3, 2])
    with left, st.container(border=True):
        st.markdown(f"**Return**: {describe(MAIN_METRIC)}")
        curves = [widgets.curve(run, MAIN_METRIC) for run in shown]
        apart = told_apart(shown)
        figure = run_curves(curves, MAIN_METRIC, 300, legend=True, keep=keep, called=apart)
        chart(
            figure, "curve main", "return against env steps, one line a run", replay_link.remember
        )
        replay_link.show(shown, called)
    with right, st.container(border=True):
        followed = now.pick_followed(shown, called)
        now.robot(followed)
    left, right = st.columns([3, 2])
    with left, st.container(border=True):
        whose = text.markdown(called[followed.run_id])
        st.markdown(f"**Weights of {whose}**: every fit, oldest transitions at the bottom")
        now.weights(followed)
    with right, st.container(border=True):
        _last_profiles(shown)
    drawn = list(metrics) or usual(shown)
    for first in range(0, len(drawn), 3):
        for column, name in zip(st.columns(3), drawn[first : first + 3], strict=False):
            with column, st.container(border=True):
                st.markdown(f"**{text.markdown(name)}**", help=text.markdown(describe(name)))
                curves = [widgets.curve(run, name) for run in shown]
                try:
                    figure = (
                        CHARTS[name](curves, 230)
                        if name in CHARTS
                        else run_curves(curves, name, 230, legend=False, keep=keep)
                    )
                except Exception as error:  # a plug-in's, which must not take the page with it
                    st.exception(error)
                    continue
                chart(figure, f"curve {name}", f"{name} against env steps")
    _warnings(shown)


def _headline(alive: int, shown: Sequence[RunReader], chosen: Sequence[str]) -> str:
    if alive:
        return f"{alive} training now · refreshed every {REFRESH_S} s"
    if not shown:
        return "Nothing is training now, and no run is left in the store"
    if any(run.run_id in chosen for run in shown):
        return "Nothing is training now: the runs chosen above"
    return f"Nothing is training now: the last runs of {text.markdown(shown[0].env)}"


def _last_profiles(runs: Sequence[RunReader]) -> None:
    lines, called = [], told_apart(runs)
    for run in runs:
        profiles, name, last = readers.profiles(run), called[run.run_id], np.zeros(0)
        if len(profiles.env_step):
            name, last = f"{name}, step {profiles.env_step[-1]:,}", profiles.bins[-1]
        lines.append((name, run.learner, last))
    head = st.container(horizontal=True, vertical_alignment="center")
    head.markdown("**Weights of the last fit**: dashed: uniform")
    if not any(len(bins) for _, _, bins in lines):
        st.caption(now.without_weights(runs))
        return
    log = widgets.pick_log(head, [bins for _, _, bins in lines])
    keep = " ".join(run.run_id for run in runs)
    figure = profile_lines(lines, 330, log=log, keep=keep)
    chart(figure, "last profile", "mean weight, oldest to newest transitions")


def _warnings(runs: Sequence[RunReader]) -> None:
    for run in runs:
        for notice in readers.notices(run)[-3:]:
            words = f"step {notice.get('env_step')}: {notice.get('message')}"
            st.warning(
                f"{text.markdown(run.run_id)}, {text.markdown(words)}", icon=":material/info:"
            )
