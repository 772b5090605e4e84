"""Statistics over seeds in one environment: profiles, who beats whom, steps to reach a value."""

from collections.abc import Sequence
from itertools import combinations

import numpy as np
import pandas as pd
import streamlit as st
from numpy.typing import NDArray
from streamlit.delta_generator import DeltaGenerator

from app import text
from app.data.aggregate import Group, interval
from app.data.readers import RunInfo
from app.data.scores import FINAL, SCORES, compared, default_level, reached, scores_of
from app.figures.curves import group_name
from app.figures.statistics import Profile, improvement, profiles
from app.parts.plot import chart
from app.views.compare import measure
from app.views.compare.curves import downloads
from tom.analysis import statistics

THRESHOLDS = 61


def draw(runs: Sequence[RunInfo]) -> None:
    """One environment, one score a run, and what its distribution says."""
    row = st.columns([3, 4, 3, 3], vertical_alignment="bottom")
    env, name, score = _pick(row, runs)
    _, grouped = measure.grouped([run for run in runs if run.env == env], name)
    if not grouped:
        st.info("None of these runs has been evaluated yet.")
        return
    until = min(float(curve.step[-1]) for group in grouped for curve in group.curves)
    early = [group for group in grouped if all(c.step[0] <= until for c in group.curves)]
    late = [text.markdown(name) for name in _names([g for g in grouped if g not in early])]
    grouped = early
    if not grouped:
        st.info(f"Nothing was recorded up to step {until:,.0f}, where the first run ends.")
        return
    scores = [scores_of(group, score, until) for group in grouped]
    everything = np.concatenate(scores)
    level = row[3].number_input(
        "Steps to reach", value=default_level(everything), step=None, format="%.6g",
        key=f"reach {env} {name} {score}",  # another score has another default
        help="sample efficiency: the first recorded step at which a run is at this value",
    )  # fmt: skip
    names = _names(grouped)
    st.caption(
        f"{text.markdown(statistics.remark([group.n for group in grouped]) or 'Ten seeds or more')}"
        f". Scores are those up to step {until:,.0f}, which every run reaches."
        + (f" Left out, as nothing was recorded until then: {', '.join(late)}." if late else "")
    )
    _profiles(grouped, names, scores, score)
    pairs = compared(names, scores)
    _improvement(pairs, [grouped[i].learner for i, _ in combinations(range(len(grouped)), 2)])
    table = reached(grouped, names, float(level), until)
    _efficiency(table, name, float(level), until)
    downloads(
        {
            "Scores": (lambda: _scores(names, grouped, scores), "scores"),
            "Improvement": (lambda: _pairs(pairs), "improvement"),
            "Steps to reach": (lambda: table, "reached"),
        },
        name,
    )


def _pick(row: Sequence[DeltaGenerator], runs: Sequence[RunInfo]) -> tuple[str | None, str, str]:
    """The environment, the metric and the score of a run that are looked at."""
    env = row[0].selectbox(
        "Environment compared", sorted({run.env for run in runs}), key="task", bind="query-params"
    )
    metric = row[1].segmented_control(
        "Of", list(measure.METRICS), default=measure.RETURN, required=True, key="of",
        bind="query-params",
    )  # fmt: skip
    score = row[2].selectbox(
        "Score of a run", SCORES, key="score", bind="query-params",
        help="all of them up to the step that every run reaches, so that a longer run has no "
        "advantage; mean height: area under the curve over its length",
    )  # fmt: skip
    return env, measure.METRICS[metric or measure.RETURN], score or FINAL


def _names(grouped: Sequence[Group]) -> list[str]:
    several = len({group.preset for group in grouped}) > 1
    return [group_name(group, several_presets=several).partition(" (")[0] for group in grouped]


def _profiles(
    grouped: Sequence[Group], names: Sequence[str], scores: Sequence[NDArray], score: str
) -> None:
    everything = np.concatenate(scores)
    margin = 0.05 * (np.ptp(everything) or 1.0)
    at = np.linspace(everything.min() - margin, everything.max() + margin, THRESHOLDS)
    draws = np.random.default_rng(0)
    found = []
    for name, group, values in zip(names, grouped, scores, strict=True):
        share = statistics.performance_profile(values[:, None], at)
        low, high = statistics.profile_band(values[:, None], at, draws, resamples=300)
        found.append(Profile(name, group.learner, share, low, high))
    with st.container(border=True):
        st.markdown("**Performance profile**: share of runs above a score, 95 % bootstrap band")
        label = f"share of runs whose {score} is above a threshold"
        chart(profiles(found, at, score, 340), "performance profile", label)
    rows = []
    for name, values in zip(names, scores, strict=True):
        row: dict[str, object] = {"group": name, "n": len(values)}
        for statistic in ("mean", "median", "iqm"):
            row[statistic] = str(interval(values, statistic))
        rows.append(row)
    st.markdown(f"**{score.capitalize()}** of the runs, with 95 % bootstrap intervals")
    st.dataframe(pd.DataFrame(rows), hide_index=True, column_config={"iqm": "IQM"})


def _improvement(
    pairs: Sequence[tuple[str, str, statistics.Interval]], learners: Sequence[str]
) -> None:
    if not pairs:
        st.caption("One group alone has nobody to be better than.")
        return
    with st.container(border=True):
        st.markdown(
            "**Probability of improvement**: that a run of the first beats a run of the second",
            help="ties count half; bars: 95 % bootstrap interval, none where a group has one run",
        )
        figure = improvement(pairs, learners, 90 + 34 * len(pairs))
        chart(figure, "improvement", "probability that a run of one group beats one of another")


def _efficiency(table: pd.DataFrame, name: str, level: float, until: float) -> None:
    st.markdown(
        f"**Sample efficiency**: env steps until {text.markdown(name)} is {level:,.6g}; "
        f"runs are followed up to step {until:,.0f}, which every run reaches"
    )
    st.dataframe(_shown(table), hide_index=True)


def _scores(names: Sequence[str], grouped: Sequence[Group], scores: Sequence[NDArray]):
    return pd.DataFrame(
        [
            {"group": name, "run": curve.run_id, "seed": curve.seed, "score": value}
            for name, group, values in zip(names, grouped, scores, strict=True)
            for curve, value in zip(group.curves, values, strict=True)
        ]
    )


def _pairs(pairs: Sequence[tuple[str, str, statistics.Interval]]) -> pd.DataFrame:
    return pd.DataFrame(
        [
            {"first": a, "second": b, "probability": p.value, "low": p.low, "high": p.high}
            for a, b, p in pairs
        ]
    )


def _shown(table: pd.DataFrame) -> pd.DataFrame:
    """The table in words: a group most of whose runs never get there has no median step."""
    found = table.copy()
    for name in ("median step", "first"):
        found[name] = [f"{at:,.0f}" if np.isfinite(at) else "not reached" for at in table[name]]
    return found.rename(columns={"first": "first run"})
