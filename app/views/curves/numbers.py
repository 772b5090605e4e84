"""Statistics over seeds in one environment: profiles, who beats whom, steps to reach a value."""

from collections.abc import Sequence
from itertools import combinations

import numpy as np
import pandas as pd
import streamlit as st
from numpy.typing import NDArray

from app import text
from app.data.tables import default_level, reached
from app.figures.curves import Style
from app.figures.statistics import Profile, improvement, profiles
from app.parts import address
from app.parts.plot import chart
from app.parts.scope import Scope
from app.views.curves import measure
from tom.analysis import statistics
from tom.analysis.curves import Group
from tom.analysis.scores import (
    HEIGHT,
    SCORES,
    all_have_started,
    common_start,
    common_step,
    interval,
    scores_of,
)
from tom.config import SAC_ALONE

RETURN = "eval/return"
NO_SAC = (
    "SAC recordings are left out: SAC never learns from their first half, which is random, so at "
    "the same step it has taken fewer steps of its own."
)


def draw(scope: Scope) -> None:
    """The distribution of one score of the return per run in one environment."""
    row = st.columns([3, 3, 3, 4], vertical_alignment="bottom")
    envs = sorted({run.env for run in scope.shown})
    env = envs[0]
    if len(envs) > 1:
        env = address.choose_one(row[2].selectbox, "Task compared", envs, "env", env)
    score = address.choose_one(
        row[0].selectbox, "Score of a run", SCORES, "score", SCORES[0],
        help="each up to the step that every run reaches, so that longer runs have no advantage; "
        "mean height: area under the curve divided by its length, from the first step that every "
        "run has",
    )  # fmt: skip
    here = [run for run in scope.shown if run.env == env and run.learner != SAC_ALONE]
    if len(here) < sum(run.env == env for run in scope.shown):
        st.caption(NO_SAC)
    _, every = measure.grouped(here, scope.kinds, RETURN)
    if not every:
        st.info("None of these runs has been evaluated yet.")
        return
    until = common_step(curve for group in every for curve in group.curves)
    grouped = [group for group in every if all_have_started(group.curves, until)]
    if not grouped:
        st.info(f"Nothing was recorded up to step {until:,.0f}, where the first run ends.")
        return
    since = common_start(curve for group in grouped for curve in group.curves)
    scores = [scores_of(group.curves, score, until, since) for group in grouped]
    level = address.number_input(
        row[1].number_input, "Steps to reach", "reach", default_level(np.concatenate(scores)),
        (env, score), step=None, format="%.6g",
        help="sample efficiency: the first recorded step at which a run is at this value",
    )  # fmt: skip
    _remarks(scope, every, grouped, until, since if score == HEIGHT else None)
    styles = [scope.styles[group.kind] for group in grouped]
    names = [look.title for look in styles]
    keep = " ".join([env, *(curve.run_id for group in grouped for curve in group.curves)])
    _profiles(styles, scores, score, keep)
    _improvement(styles, scores, f"{score} {keep}")
    table = reached(grouped, names, level, until)
    _efficiency(table, level, until)
    with st.expander("The score of each run"):
        of_runs = (
            {"group": name, "run": curve.run_id, "seed": curve.seed, "score": value}
            for name, group, values in zip(names, grouped, scores, strict=True)
            for curve, value in zip(group.curves, values, strict=True)
        )
        st.dataframe(pd.DataFrame(of_runs), hide_index=True, alt="The score of each run")


def _remarks(
    scope: Scope,
    every: Sequence[Group],
    grouped: Sequence[Group],
    until: float,
    since: float | None,
) -> None:
    """What a reader of the scores has to know; `since`: from where on heights count."""
    few = statistics.remark([group.n for group in grouped]) or "Ten seeds or more"
    words = [f"{text.markdown(few.replace('seed', scope.unit.removesuffix('s')))}."]
    if measure.has_repeated_seed(grouped):
        words.append("A seed run twice counts twice.")
    ends = sorted((curve.step[-1], curve.run_id) for group in every for curve in group.curves)
    words.append(f"Scores count up to step {until:,.0f}, which every run reaches.")
    if len(ends) > 1 and ends[0][0] < ends[1][0]:
        words.append(
            f"The record of {text.markdown(ends[0][1])} ends there; without it, they would go on."
        )
    if since is not None:
        words.append(f"Heights count from step {since:,.0f}, which every run has.")
    late = [text.markdown(scope.styles[g.kind].title) for g in every if g not in grouped]
    if late:
        words.append(f"Left out (nothing was recorded by then): {', '.join(late)}.")
    st.caption(" ".join(words))


def _profiles(styles: Sequence[Style], scores: Sequence[NDArray], score: str, keep: str) -> None:
    everything = np.concatenate(scores)
    margin = 0.05 * (np.ptp(everything) or 1.0)
    ends = everything.min() - margin, everything.max() + margin
    at = np.unique(np.append(everything, ends))  # shares change at scores alone
    of_groups = [  # a band is the same beside any other group
        Profile(
            style,
            statistics.performance_profile([values], at),
            *statistics.profile_band([values], at, resamples=300),
        )
        for style, values in zip(styles, scores, strict=True)
    ]
    with st.container(border=True):
        title = "**Performance profile**: share of runs above a score, 95 % bootstrap band"
        st.markdown(text.unbroken(title))
        label = f"share of runs whose {score} is above a threshold"
        chart(profiles(of_groups, at, score, 340, keep), "performance profile", label)
    rows = [
        {"group": style.title, "n": len(values)}
        | {statistic: str(interval(values, statistic)) for statistic in ("mean", "median", "iqm")}
        for style, values in zip(styles, scores, strict=True)
    ]
    title = f"**{score.capitalize()}** of the runs, with 95 % bootstrap intervals"
    st.markdown(text.unbroken(title))
    st.dataframe(pd.DataFrame(rows), hide_index=True, column_config={"iqm": "IQM"}, alt=score)


def _improvement(styles: Sequence[Style], scores: Sequence[NDArray], keep: str) -> None:
    """Who beats whom."""
    both = list(combinations(range(len(styles)), 2))
    if not both:
        st.caption("The probability of improvement needs a second group.")
        return
    ps = [statistics.exchangeable([scores[i]], [scores[j]]) for i, j in both]
    beats = [statistics.probability_of_improvement([scores[i]], [scores[j]]) for i, j in both]
    pairs = pd.DataFrame(
        {
            "first": styles[i].title, "second": styles[j].title, "probability": won.value,
            "low": won.low, "high": won.high, "p": p, "p corrected": of_all,
        }
        for (i, j), won, p, of_all in zip(both, beats, ps, statistics.corrected(ps), strict=True)
    )  # fmt: skip
    with st.container(border=True):
        st.markdown(
            "**Probability of improvement**: that a run of the first group beats one of the second",
            help="Ties count half. Bars: 95 % bootstrap interval, too narrow for few runs, absent "
            "if a group has one run. p: by permutation of the runs, right for few. Corrected: for "
            "the number of pairs (Holm), but not for other pages and steps that were looked at.",
        )
        colours = [styles[i].colour for i, _ in both]
        figure = improvement(pairs, colours, 90 + 40 * len(pairs), keep)
        chart(figure, "improvement", "probability that a run of one group beats one of another")


def _efficiency(table: pd.DataFrame, level: float, until: float) -> None:
    st.markdown(
        f"**Sample efficiency**: steps until the return is {level:,.6g}; "
        f"runs are followed up to step {until:,.0f}, which every run reaches"
    )
    steps = {
        name: [f"{at:,.0f}" if np.isfinite(at) else "not reached" for at in table[name]]
        for name in ("median step", "first")
    }
    shown = table.assign(**steps).rename(columns={"first": "first run"})
    st.dataframe(shown, hide_index=True, alt="Sample efficiency")
