"""Curves: a line and a band per group, a figure per environment, a table and CSV files."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial

import numpy as np
import pandas as pd
import streamlit as st
from streamlit.delta_generator import DeltaGenerator

from app import text
from app.data import tables
from app.data.called import names, task, told_apart
from app.figures.curves import group_curves, line_uid, metric_title, run_curves
from app.parts.eyes import eyes
from app.parts.plot import View, chart
from app.views.compare import measure, replay_beside, zoom
from app.views.compare.comparison import ALIKE, Comparison, hide, switched, toggled
from app.views.compare.measure import Measure
from tom.analysis import statistics
from tom.analysis.curves import Curve, Group
from tom.analysis.scores import common_step
from tom.config import SAC_ALONE
from tom.harmless import as_csv
from tom.readable import UNKNOWN, short

Files = Mapping[str, tuple[Callable[[], pd.DataFrame], str]]
NAMES = {"mean": "mean", "median": "median", "iqm": "interquartile mean"}


def draw(comparison: Comparison, controls: DeltaGenerator) -> None:
    """The figures with their remarks, the table, and all of it as CSV.

    The user chooses in `controls` what is measured and how.
    """
    with controls.popover("Measure", icon=":material/tune:"):
        how = measure.choose(comparison.runs)
    curves, grouped = measure.grouped(
        comparison.members, comparison.kinds, how.metric, how.axes.x, how.statistic, how.band
    )
    views = zoom.views((how.metric, how.axes.x))
    beside = replay_beside.clicked_replay(comparison.runs) if how.axes.x == measure.STEPS else None
    # A replay takes the place of the list: with three columns the figure would be too narrow.
    left, right = st.columns([3, 2] if beside else [4, 1])
    with left:
        _figures(grouped, curves, how, comparison, views)
    with right:
        if beside:
            replay_beside.show(*beside, called=names(comparison.runs)[beside[0].run_id])
        else:
            _list(comparison)
    off = comparison.hidden_kinds
    curves = [curve for curve in curves if curve.kind not in off]
    if not any(len(curve.step) for curve in curves):
        return
    files: Files = {"Single runs": (lambda: tables.runs(curves, how.axes.x), "runs")}
    if grouped := [group for group in grouped if group.kind not in off]:
        _remarks(grouped, curves, how, comparison)
        table = best_as_highest(tables.summary(grouped), how.metric)
        st.dataframe(in_words(table), hide_index=True, column_config=columns())
        lines = (lambda: tables.bands(grouped, how.axes.x), "lines")
        files = {"Lines and bands": lines, **files, "Table": (lambda: table, "table")}
    downloads(files, how.metric)


def _list(comparison: Comparison) -> None:
    hidden = comparison.hidden
    with st.container(border=True):
        eyes(
            comparison.rows(),
            "eyes",
            toggled=lambda word: hide(toggled(hidden, word)),
            everything=lambda: hide([]),
        )


def _figures(
    grouped: Sequence[Group],
    curves: Sequence[Curve],
    how: Measure,
    comparison: Comparison,
    views: Mapping[str, View],
) -> None:
    """One figure per environment; it shows single runs if no mean can be computed."""
    envs = sorted({curve.env for curve in curves if len(curve.step)})
    if not envs:
        hidden = "Every run is hidden." if not curves else ""
        st.info(hidden or f"None of these runs has recorded {text.markdown(how.metric)} yet.")
        return
    if not grouped:
        st.caption(
            f"{text.markdown(how.axes.x)} goes to and fro, so runs are drawn one by one, in the "
            "order of their env steps; no mean can be taken."
        )
    wide = len(envs) == 1
    layout = st.columns(1 if wide else 2)
    for i, env in enumerate(envs):
        with layout[i % len(layout)], st.container(border=True):
            words = text.markdown(metric_title(how.metric))
            st.markdown(f"**{text.markdown(task(env))}**, {words}")
            size = (460, 840) if wide else (360, 400)
            _figure(env, grouped, curves, how, comparison, views, size)
    if grouped and how.axes.x == measure.STEPS:
        st.caption("Click a point of a line for the replay nearest to it.")


def _figure(
    env: str,
    grouped: Sequence[Group],
    curves: Sequence[Curve],
    how: Measure,
    comparison: Comparison,
    views: Mapping[str, View],
    size: tuple[int, int],
) -> None:
    """The figure of one environment; `size` is its height and least width in pixels."""
    height, width = size
    off, looks = comparison.hidden_kinds, comparison.looks
    if here := [group for group in grouped if group.env == env]:
        figure = group_curves(
            here, how.metric, height, singles=how.singles, axes=how.axes, window=how.window,
            looks=looks, hidden=off, width=width,
        )  # fmt: skip
        entries = {line_uid(group): looks[group.kind].title for group in here}
    else:
        alone = [c for c in curves if c.env == env and len(c.step) and c.kind not in off]
        apart = told_apart([run for run in comparison.runs if run.env == env])
        figure = run_curves(
            alone, how.metric, height, legend=len(alone) <= 12, axes=how.axes, looks=looks,
            called=apart,
        )  # fmt: skip
        entries = {line_uid(curve): curve.run_id for curve in alone}

    def switch(uids: Sequence[str]) -> None:
        off = [entries[uid] for uid in uids if uid in entries]
        hide(switched(comparison.hidden, off, list(entries.values())))

    on_steps = bool(grouped) and how.axes.x == measure.STEPS
    chart(
        figure,
        f"compare {env}",
        f"{how.metric} against {how.axes.x} in {env}",
        partial(replay_beside.remember, curves) if on_steps else None,
        view=views.get(env, zoom.ALL),
        viewed=lambda view: zoom.remember(zoom.zoomed(views, env, view)),
        hidden=switch,
    )


def _remarks(
    grouped: Sequence[Group], curves: Sequence[Curve], how: Measure, comparison: Comparison
) -> None:
    unit = comparison.unit
    words = [f"Line: {NAMES[how.statistic]} over {unit}."]
    if how.band == "bootstrap":
        words[0] += f" Band: 95 % bootstrap interval of the {NAMES[how.statistic]} "
        words[0] += f"(1000 resamples of the {unit})."
    elif how.band == "deviation":
        words[0] += f" Band: one standard deviation of the {unit} around their mean."
    if not comparison.only_seeds_differ:
        by = text.markdown(comparison.by)
        words.append(f"Grouped by {by}: runs of a group may differ in everything else.")
    few = min((group.n for group in grouped if group.n > 1), default=0)
    if few and (warning := statistics.remark(few)):
        warning = warning.replace("seeds", unit)
        if how.band != "bootstrap":  # the figure has no such interval, the table has
            warning = warning.replace("such intervals", "of the table's intervals")
        words.append(f"{text.markdown(warning).capitalize()}.")
    if any(group.n == 1 for group in grouped):
        words.append("One seed has no band: a single run says little.")
    if any(not group.complete.all() for group in grouped):
        words.append("Dotted: not all n runs reach these steps.")
    if any(group.interpolated for group in grouped):
        words.append("Runs that were recorded at other steps are interpolated between theirs.")
    if unlike_ends(grouped):
        words.append("Rows of the table end at different steps: Statistics compares at one.")
    if comparison.only_seeds_differ and any(group.variant for group in grouped):
        words.append("Settings that set runs of one learner apart are named.")
    if twice := comparison.twice(grouped):
        words.append(twice)
    if any(curve.learner == SAC_ALONE for curve in curves):
        words.append("The first half of a recording of SAC is random steps, which count here.")
    if cut := comparison.cut_short:
        which = ", ".join(f"{names(cut)[run.run_id]} ({run.status.env_step:,})" for run in cut)
        words.append(f"Left out, as they ended well before the others: {text.markdown(which)}.")
    if empty := sum(not len(curve.step) for curve in curves):
        have = "1 run has" if empty == 1 else f"{empty} runs have"
        words.append(f"{have} recorded nothing of this yet.")
    st.caption(" ".join(words))


def unlike_ends(grouped: Sequence[Group]) -> bool:
    """Whether the rows of an environment's table end at clearly different steps."""
    ends: dict[str, list[float]] = {}
    for group in grouped:
        ends.setdefault(group.env, []).append(common_step(group.curves))
    return any(min(of) < ALIKE * max(of) for of in ends.values())


def best_as_highest(table: pd.DataFrame, metric: str) -> pd.DataFrame:
    """The table with `highest` for `best` unless `metric` is a return.

    The highest value of other metrics, such as an error, may be the worst.
    """
    if metric in measure.METRICS.values():
        return table
    return table.rename(columns=lambda name: name.replace("best", "highest", 1))


def in_words(table: pd.DataFrame) -> pd.DataFrame:
    """The table with each interval in one column of text, without empty columns."""
    shown = table.copy()
    for name in [name.removesuffix(" low") for name in table if name.endswith(" low")]:
        low, high = shown.pop(f"{name} low"), shown.pop(f"{name} high")
        words = [
            f"{short(a, 4)} to {short(b, 4)}" if np.isfinite(a) else UNKNOWN
            for a, b in zip(low, high, strict=True)
        ]
        shown.insert(list(shown.columns).index(name) + 1, f"{name}, 95 %", words)
    silent = [name for name in ("learner", "preset", "settings") if not any(shown[name].tolist())]
    return shown.drop(columns=silent)


def columns() -> dict:
    number = st.column_config.NumberColumn
    return {
        # In pixels: the widest names would be cut while a count has room to spare.
        "learner": st.column_config.TextColumn("learner", width=125),
        "settings": st.column_config.TextColumn("settings", width="medium"),
        "n": number("n", width=45, help="runs in the group"),
        "steps": number("up to", format="localized", help="where the shortest of the n runs ends"),
        "final": number(
            "final", format="%.4g", help="over runs, of the value at that step, as the line has it"
        ),
        **{
            name: number(
                name, format="%.4g", help=f"over runs, of the {name} value up to that step"
            )
            for name in ("best", "highest")
        },
    }


def downloads(files: Files, name: str) -> None:
    """A download button for each table; its CSV file is made when the user asks for it."""
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
