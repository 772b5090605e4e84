"""Curves: learners against each other over seeds, in a grid of panels, in statistics and tables."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from itertools import product

import numpy as np
import pandas as pd
import plotly.graph_objects as go
import streamlit as st
from streamlit.delta_generator import DeltaGenerator

from app import session, text
from app.data import readers, tables
from app.data.cache import get_or_make
from app.data.run_names import distinct_names, full_names, task_title
from app.figures.base import step_axis_title
from app.figures.curves import group_curves, label_ends, short_title, single_run_group
from app.parts import address, shortlinks, timeline, widgets
from app.parts.plot import FigureJson, Follow, Point, View, chart
from app.parts.scope import Scope
from app.views.curves import measure, numbers, runs
from app.views.curves.measure import Measure
from tom.analysis import statistics
from tom.analysis.curves import Curve, Group
from tom.analysis.grouping import SHOWN_GROUPS
from tom.analysis.weight_readers import first_weight_reader, weight_readers
from tom.config import SAC_ALONE
from tom.metrics import describe
from tom.plugins import CHARTS
from tom.readable import UNKNOWN, short
from tom.record.reader import RunReader

CURVES, STATISTICS, SETTINGS, RUNS = "Curves", "Statistics", "Settings", "Runs"
REFRESH_S = 5
CLICKED = "curves: a point was clicked"
PANEL_HEIGHT = 300
_number = st.column_config.NumberColumn
COLUMNS = {
    "settings": st.column_config.TextColumn("settings", width="medium"),
    "n": _number("n", width=45, help="runs in the group"),
    "steps": _number("up to", format="localized", help="where the shortest of the n runs ends"),
    "final": _number("final", format="%.4g", help="over runs, of the line's value at that step"),
    **{
        name: _number(name, format="%.4g", help=f"over runs, of the {name} value up to that step")
        for name in ("best", "highest")
    },
}
NAMES = {"mean": "mean", "median": "median", "iqm": "interquartile mean"}


def page(scope: Scope) -> None:
    """One row of controls; below it panels, statistics, settings or the table of runs."""
    row = st.container(horizontal=True, vertical_alignment="center", gap="small")
    section = address.choose_part([CURVES, STATISTICS, SETTINGS, RUNS], place=row)
    if section == CURVES:
        _curves(scope, row)
    elif section == RUNS:
        runs.draw(scope)
    elif not scope.shown:
        st.info("Every run is hidden. Click an eye on the left to show its runs again.")
    elif section == SETTINGS:
        runs.settings(scope.shown)
    else:
        numbers.draw(scope)
    with row:
        shortlinks.button()
    for run in scope.shown:
        # Without the problems of weights: reading the profiles of every run takes seconds.
        widgets.show_problems(run, readers.metrics_problems(run))
    widgets.show_store_problems(readers.listing(session.links().store).problems)


def _curves(scope: Scope, row: DeltaGenerator) -> None:
    recorded = measure.favourites_first(
        name for run in scope.runs for name in readers.metric_counts(run)
    )
    usual = [name for name in measure.FIRST[:4] if name in recorded]
    options = [*dict.fromkeys([*recorded, *st.session_state.get("panel", ())])]  # of other tasks
    chosen = address.choose_many(
        "Panels", options, "panel", default=usual or recorded[:1], label_visibility="collapsed",
        placeholder="add a metric",
    )  # fmt: skip
    with row.popover("Lines", icon=":material/tune:"):
        how = measure.choose(recorded)
    alive = any(run.status.alive for run in scope.runs)
    st.fragment(_panels, run_every=REFRESH_S if alive else None)(scope, chosen, how)
    run = scope.choose_run(lambda run: bool(weight_readers(run)), widgets.interest_key)
    if run is not None and how.axes.x == measure.STEPS:
        fits = readers.profiles(first_weight_reader(run)).env_step.tolist()
        evaluations = run.evaluation_steps()
        if stops := sorted({*fits, *evaluations}):
            timeline.draw(fits, evaluations, timeline.chosen_step(stops))


def _panels(scope: Scope, metrics: Sequence[str], how: Measure) -> None:
    if st.session_state.pop(CLICKED, False):
        st.rerun()  # the list of runs and the timeline are not parts of the panels
    envs = sorted({run.env for run in scope.shown})
    if not envs:
        st.info("Every run is hidden. Click an eye on the left to show its runs again.")
        return
    # Panels are drawn again alone, when the scope's own runs have long been read.
    now = {run.run_id: run for run in readers.listing(session.links().store).runs}
    seen = measure.zoom((how.axes.x, *sorted({run.env for run in scope.runs})))
    first_curves, first_groups = list[Curve](), list[Group]()
    on_steps = how.axes.x == measure.STEPS
    grid = st.container(horizontal=True, key="grid")
    for metric, env in product(metrics, envs):
        here = [now.get(run.run_id, run) for run in scope.shown if run.env == env]
        curves, grouped = measure.grouped(
            here, scope.kinds, metric, how.axes.x, how.statistic, how.band
        )
        if metric == metrics[0]:
            first_curves += curves
            first_groups += grouped
        with grid, st.container(border=True):
            where = f"{task_title(env)}: " if len(envs) > 1 else ""
            title = text.markdown(where + short_title(metric))
            st.markdown(
                f"**{title}**", help=text.with_glossary_links(text.markdown(describe(metric)))
            )
            if not any(len(curve.step) for curve in curves):
                st.caption("None of these runs has recorded it yet.")
                continue
            figure = _figure(metric, curves, grouped, how, scope, here)
            if figure is not None:
                panel = f"{env} {metric}" if len(envs) > 1 else metric
                chart(
                    figure, f"curve {env} {metric}", f"{metric} against {how.axes.x} in {env}",
                    partial(_clicked, curves) if on_steps else None,
                    view=View(seen.get(""), seen.get(panel)),
                    viewed=partial(measure.set_zoom, seen, panel),
                    follow=Follow(cursor=on_steps), linked="curves",
                    caption=caption(metric, env, grouped, how, scope),
                )  # fmt: skip
    if first_groups:
        st.caption(remarks(first_groups, first_curves, how, scope))
        table = tables.summary(first_groups)
        if metrics[0] not in ("eval/return", "eval/return_max"):
            # The highest value of another metric, such as an error, may be the worst.
            table = table.rename(columns=lambda name: name.replace("best", "highest", 1))
        st.markdown(f"**{text.markdown(metrics[0])}** at the step that all runs of a group reach")
        st.dataframe(
            with_interval_text(table), hide_index=True, column_config=COLUMNS, alt="The groups"
        )


def _figure(
    metric: str,
    curves: Sequence[Curve],
    grouped: Sequence[Group],
    how: Measure,
    scope: Scope,
    here: Sequence[RunReader],
) -> go.Figure | FigureJson | None:
    """The figure of one panel; None if a plug-in's chart failed, which the page then shows."""
    if metric in CHARTS:
        try:
            return CHARTS[metric](curves, PANEL_HEIGHT)
        except Exception as error:  # a plug-in's, which must not take the page with it
            st.exception(error)
            return None
    styles = {scope.kinds[run.run_id]: scope.styles[scope.kinds[run.run_id]] for run in here}
    groups = list(grouped)
    if not grouped:
        st.caption("Values go back and forth along this axis, so each run has its own line.")
        names = distinct_names(here)
        for curve in (curve for curve in curves if len(curve.step)):
            groups.append(single_run_group(curve, names[curve.run_id]))
            styles[groups[-1].kind] = replace(styles[curve.kind], title=names[curve.run_id])

    def make() -> FigureJson:
        figure = group_curves(
            groups, metric, PANEL_HEIGHT, singles=how.singles, axes=how.axes, window=how.window,
            styles=styles,
        )  # fmt: skip
        if len(groups) <= SHOWN_GROUPS:
            label_ends(figure, groups, styles, how.axes)
        return FigureJson.of(figure)

    key = measure.cache_key(here, scope.kinds), metric, how, *styles.items()
    return get_or_make(("panel", *key), None, make)


def caption(metric: str, env: str, grouped: Sequence[Group], how: Measure, scope: Scope) -> str:
    """A caption for a saved figure: what is drawn, the interval, and n of each group."""
    bands = {"bootstrap": ", band: 95 % bootstrap interval", "deviation": ", band: one deviation"}
    named = ", ".join(f"{scope.styles[group.kind].title} (n = {group.n})" for group in grouped)
    smooth = f", moving average of {how.window} points" if how.window > 1 else ""
    of = step_axis_title({env}) if how.axes.x == measure.STEPS else how.axes.x
    line = f"Line: {NAMES[how.statistic]} over {scope.unit}{bands.get(how.band, '')}"
    drawn = f"{line}{smooth}. {named}" if grouped else f"Lines: single runs{smooth}"
    return f"{short_title(metric)} on {task_title(env)} against {of}. {drawn}."


def _clicked(curves: Sequence[Curve], point: Point) -> None:
    """Choose the run of a clicked line, on a mean the nearest one, and its step."""
    named = point.meta if isinstance(point.meta, list) else [point.meta]
    near = [c for c in curves if c.run_id in named and len(c.step) and c.step[-1] >= point.x]
    if near:
        away = [abs(float(np.interp(point.x, c.step, c.value)) - point.y) for c in near]
        st.session_state["run"] = [near[int(np.argmin(away))].run_id]
    timeline.go_to(int(point.x))
    st.session_state[CLICKED] = True


def remarks(grouped: Sequence[Group], curves: Sequence[Curve], how: Measure, scope: Scope) -> str:
    """What a reader of the figures has to know of their lines and bands."""
    unit, cut = scope.unit, scope.cut_short
    few = min((group.n for group in grouped if group.n > 1), default=0)
    warning = text.markdown(statistics.remark(few).replace("seeds", unit)) if few else ""
    which = ", ".join(f"{full_names(cut)[run.run_id]} ({run.status.env_step:,})" for run in cut)
    bands = {
        "bootstrap": f"Band: its 95 % bootstrap interval (1000 resamples of the {unit}).",
        "deviation": f"Band: one standard deviation of the {unit} around their mean.",
    }
    sentences = {
        f"Line: {NAMES[how.statistic]} over {unit}.": True,
        bands.get(how.band, ""): how.band in bands,
        f"Grouped by {text.markdown(scope.by)}: everything else may differ.": unit == "runs",
        f"{warning.capitalize()}.": bool(warning),
        "One seed has no band: a single run says little.": any(g.n == 1 for g in grouped),
        "Dotted: not all n runs reach these steps.": not all(g.complete.all() for g in grouped),
        "Runs recorded at other steps are interpolated.": any(
            group.interpolated for group in grouped
        ),
        "A seed run twice counts twice.": unit == "seeds" and measure.has_repeated_seed(grouped),
        "The first half of a SAC recording is random steps, which count here.": any(
            curve.learner == SAC_ALONE for curve in curves
        ),
        f"Left out (ended well before the others): {text.markdown(which)}.": bool(cut),
    }
    return text.unbroken(" ".join(words for words, holds in sentences.items() if holds))


def with_interval_text(table: pd.DataFrame) -> pd.DataFrame:
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
