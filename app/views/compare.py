"""Compare: learners against each other, mean and band over seeds, in numbers that can be taken."""

from collections.abc import Sequence

import numpy as np
import pandas as pd
import streamlit as st

from app import readers, session, tables, text, widgets
from app.aggregate import Curve, Group, groups
from app.figures.curves import group_curves, metric_title
from app.plot import chart
from app.readers import RunInfo
from app.theme import learner_label

TITLE = "Compare"
ICON = ":material/stacked_line_chart:"
PATH = "compare"

RETURN = "return"
RUNNING_MAXIMUM = "running maximum"
OTHER = "another metric"
_METRICS = {RETURN: "eval/return", RUNNING_MAXIMUM: "eval/return_max"}


def page() -> None:
    """Filters, one figure an environment, a table, and everything as CSV."""
    listing = readers.listing(session.links().store)
    runs = _filtered(listing.runs)
    if not runs:
        st.info("No run passes these filters.", icon=":material/filter_alt_off:")
        return
    metric = _metric(runs)
    curves = [widgets.curve(run, metric) for run in runs]
    grouped = groups(curves)
    singles = st.session_state.get("singles", True)
    _figures(grouped, metric, singles=singles)
    _remarks(grouped, curves)
    table = tables.summary(grouped)
    if grouped:
        st.dataframe(_shown(table), hide_index=True, column_config=_columns())
    _downloads(grouped, curves, table, metric)
    for run in runs:
        if problems := readers.problems(run):
            widgets.show_problems(run, problems)
    widgets.show_store_problems(listing.problems)


def _filtered(runs: Sequence[RunInfo]) -> list[RunInfo]:
    with st.container(border=True):
        first = st.columns(4)
        choices = {
            "env": ("Environment", str),
            "learner": ("Learner", learner_label),
            "preset": ("Preset", str),
        }
        kept = list(runs)
        for column, (name, (label, shown)) in zip(first, choices.items(), strict=False):
            options = sorted({getattr(run, name) for run in runs})
            picked = column.multiselect(
                label, options, key=name, bind="query-params", placeholder="all", format_func=shown
            )
            kept = [run for run in kept if not picked or getattr(run, name) in picked]
        words = first[3].text_input(
            "Run name contains", key="text", bind="query-params", placeholder="any"
        )
        return [run for run in kept if (words or "").lower() in run.run_id.lower()]


def _metric(runs: Sequence[RunInfo]) -> str:
    row = st.columns([3, 4, 3], vertical_alignment="bottom")
    kind = row[0].segmented_control(
        "Measure",
        [RETURN, RUNNING_MAXIMUM, OTHER],
        default=RETURN,
        required=True,
        key="measure",
        bind="query-params",
    )
    names = sorted({name for run in runs for name in readers.metrics(run).columns} - {"env_step"})
    other = row[1].selectbox(
        "Metric",
        names,
        key="metric",
        bind="query-params",
        disabled=kind != OTHER,
        format_func=str,
        help="any metric that these runs recorded",
    )
    row[2].toggle("single seeds", value=True, key="singles", bind="query-params")
    return _METRICS.get(kind or RETURN) or other or "eval/return"


def _figures(grouped: Sequence[Group], metric: str, *, singles: bool) -> None:
    envs = sorted({group.env for group in grouped})
    if not envs:
        st.info(f"None of these runs has recorded {text.markdown(metric)} yet.")
        return
    st.caption(text.markdown(metric_title(metric)))
    wide = len(envs) == 1
    columns = st.columns(1 if wide else 2)
    for i, env in enumerate(envs):
        here = [group for group in grouped if group.env == env]
        with columns[i % len(columns)], st.container(border=True):
            st.markdown(f"**{text.markdown(env)}**")
            figure = group_curves(here, metric, 460 if wide else 360, singles=singles)
            chart(figure, f"compare {env}", f"{metric} against env steps in {env}")


def _remarks(grouped: Sequence[Group], curves: Sequence[Curve]) -> None:
    words = ["Line: mean over seeds. Band: 95 % bootstrap interval of the mean (1000 resamples)."]
    if any(group.n == 1 for group in grouped):
        words.append("One seed has no band: a single run says little.")
    if any(not group.complete.all() for group in grouped):
        words.append("Dotted: not all n runs reach these steps.")
    if any(group.interpolated for group in grouped):
        words.append("Runs that were recorded at other steps are interpolated between theirs.")
    if any(len({c.seed for c in g.curves}) < g.n for g in grouped):
        words.append("A seed that was run twice counts twice.")
    if empty := sum(not len(curve.step) for curve in curves):
        words.append(f"{empty} runs have recorded nothing of this yet.")
    st.caption(" ".join(words))


def _shown(table: pd.DataFrame) -> pd.DataFrame:
    """The table with each interval in one column of words."""
    shown = table.copy()
    for name in ("final", "best"):
        low, high = shown.pop(f"{name} low"), shown.pop(f"{name} high")
        words = [
            f"{text.number(a)} to {text.number(b)}" if np.isfinite(a) else "-"
            for a, b in zip(low, high, strict=True)
        ]
        shown.insert(list(shown.columns).index(name) + 1, f"{name}, 95 %", words)
    return shown


def _columns() -> dict:
    number = st.column_config.NumberColumn
    return {
        "n": number("n", help="runs in the group"),
        "steps": number("steps", format="localized", help="the last step that all n runs reach"),
        "final": number("final", format="%.4g", help="mean over runs of the last value"),
        "best": number("best", format="%.4g", help="mean over runs of the best value"),
    }


def _downloads(
    grouped: Sequence[Group], curves: Sequence[Curve], table: pd.DataFrame, metric: str
) -> None:
    with st.container(horizontal=True):
        for label, make, name in (
            ("Mean and band", lambda: tables.bands(grouped), "mean"),
            ("Single runs", lambda: tables.runs(curves), "runs"),
            ("Table", lambda: table, "table"),
        ):
            st.download_button(
                label,
                lambda make=make: make().to_csv(index=False),
                f"{metric.replace('/', '-')}-{name}.csv",
                "text/csv",
                icon=":material/download:",
                on_click="ignore",
                key=f"download {name}",
            )
