"""Curves: a line and a band for each learner, a figure for each environment, a table, CSV."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np
import pandas as pd
import streamlit as st

from app import text
from app.data import tables
from app.data.aggregate import Curve, Group
from app.data.readers import RunInfo
from app.figures.curves import group_curves, metric_title, run_curves
from app.parts import replay_link
from app.parts.plot import chart
from app.views.compare import measure
from app.views.compare.measure import Measure
from tom.analysis import statistics
from tom.harmless import as_csv

NAMES = {"mean": "mean", "median": "median", "iqm": "interquartile mean"}


def draw(runs: Sequence[RunInfo]) -> None:
    """The figures, what must be said about them, the table, and all of it as CSV."""
    how = measure.choose(runs)
    found, grouped = measure.grouped(runs, how.metric, how.axes.x, how.statistic, how.band)
    if not any(len(curve.step) for curve in found):
        st.info(f"None of these runs has recorded {text.markdown(how.metric)} yet.")
        return
    st.caption(text.markdown(metric_title(how.metric)))
    if not grouped:
        _crossing(found, how)
        return
    _figures(grouped, how)
    _remarks(grouped, found, how)
    if how.axes.x == measure.STEPS:
        replay_link.show(runs)
    table = named(tables.summary(grouped), how.metric)
    st.dataframe(shown(table), hide_index=True, column_config=columns())
    downloads(
        {
            "Lines and bands": (lambda: tables.bands(grouped, how.axes.x), "lines"),
            "Single runs": (lambda: tables.runs(found, how.axes.x), "runs"),
            "Table": (lambda: table, "table"),
        },
        how.metric,
    )


def _figures(grouped: Sequence[Group], how: Measure) -> None:
    envs = sorted({group.env for group in grouped})
    wide = len(envs) == 1
    layout = st.columns(1 if wide else 2)
    for i, env in enumerate(envs):
        here = [group for group in grouped if group.env == env]
        with layout[i % len(layout)], st.container(border=True):
            st.markdown(f"**{text.markdown(env)}**")
            figure = group_curves(
                here,
                how.metric,
                460 if wide else 360,
                singles=how.singles,
                axes=how.axes,
                window=how.window,
            )
            label = f"{how.metric} against {how.axes.x} in {env}"
            clicked = replay_link.remember if how.axes.x == measure.STEPS else None
            chart(figure, f"compare {env}", label, clicked)


def _crossing(found: Sequence[Curve], how: Measure) -> None:
    """One metric against another that goes to and fro: single runs only."""
    st.caption(
        f"{text.markdown(how.axes.x)} goes to and fro, so runs are drawn one by one, in the order "
        "of their env steps; no mean can be taken."
    )
    for env in sorted({curve.env for curve in found if len(curve.step)}):
        here = [curve for curve in found if curve.env == env and len(curve.step)]
        with st.container(border=True):
            st.markdown(f"**{text.markdown(env)}**")
            figure = run_curves(here, how.metric, 420, legend=len(here) <= 12, axes=how.axes)
            chart(figure, f"crossing {env}", f"{how.metric} against {how.axes.x} in {env}")
    downloads({"Single runs": (lambda: tables.runs(found, how.axes.x), "runs")}, how.metric)


def _remarks(grouped: Sequence[Group], found: Sequence[Curve], how: Measure) -> None:
    words = [f"Line: {NAMES[how.statistic]} over seeds."]
    if how.band == "bootstrap":
        words[0] += f" Band: 95 % bootstrap interval of the {NAMES[how.statistic]} "
        words[0] += "(1000 resamples of the seeds)."
    elif how.band == "deviation":
        words[0] += " Band: one standard deviation of the seeds around their mean."
    few = min((group.n for group in grouped if group.n > 1), default=0)
    if few and statistics.remark(few):
        words.append(f"{text.markdown(statistics.remark(few)).capitalize()}.")
    if any(group.n == 1 for group in grouped):
        words.append("One seed has no band: a single run says little.")
    if any(not group.complete.all() for group in grouped):
        words.append("Dotted: not all n runs reach these steps.")
    if any(group.interpolated for group in grouped):
        words.append("Runs that were recorded at other steps are interpolated between theirs.")
    if any(group.variant for group in grouped):
        words.append("Settings that set runs of one learner apart are named.")
    if any(len({c.seed for c in g.curves}) < g.n for g in grouped):
        words.append("A seed that was run twice counts twice.")
    if empty := sum(not len(curve.step) for curve in found):
        have = "1 run has" if empty == 1 else f"{empty} runs have"
        words.append(f"{have} recorded nothing of this yet.")
    st.caption(" ".join(words))


def named(table: pd.DataFrame, metric: str) -> pd.DataFrame:
    """The table, with no talk of the best where the highest value may be the worst: an error's."""
    if metric in measure.METRICS.values():
        return table
    return table.rename(columns=lambda name: name.replace("best", "highest", 1))


def shown(table: pd.DataFrame) -> pd.DataFrame:
    """The table with each interval in one column of words, without columns that say nothing."""
    found = table.copy()
    for name in [name.removesuffix(" low") for name in table if name.endswith(" low")]:
        low, high = found.pop(f"{name} low"), found.pop(f"{name} high")
        words = [
            f"{a:,.4g} to {b:,.4g}" if np.isfinite(a) else "-"
            for a, b in zip(low, high, strict=True)
        ]
        found.insert(list(found.columns).index(name) + 1, f"{name}, 95 %", words)
    return found if any(found["settings"].tolist()) else found.drop(columns="settings")


def columns() -> dict:
    number = st.column_config.NumberColumn
    return {
        "n": number("n", help="runs in the group"),
        "steps": number("up to", format="localized", help="where the shortest of the n runs ends"),
        "final": number(
            "final", format="%.4g", help="over runs, of the last value up to that step"
        ),
        **{
            name: number(
                name, format="%.4g", help=f"over runs, of the {name} value up to that step"
            )
            for name in ("best", "highest")
        },
    }


def downloads(files: Mapping[str, tuple[Callable[[], pd.DataFrame], str]], name: str) -> None:
    """A button for each table, which is made when it is asked for and given as CSV."""
    with st.container(horizontal=True):
        for label, (make, suffix) in files.items():
            st.download_button(
                label,
                lambda make=make: as_csv(make()),
                f"{name.replace('/', '-')}-{suffix}.csv",
                "text/csv",
                icon=":material/download:",
                on_click="ignore",
                key=f"download {label}",
            )
