"""Road and rocks: the weights on the map in 3D and 2D, and the resulting performance."""

import numpy as np
import pandas as pd
import streamlit as st

from app import session, text
from app.data import readers, road
from app.data.called import names, told_apart
from app.data.road import Picture
from app.figures.road import cells, road_map
from app.parts import address, widgets
from app.parts.plot import Follow, chart
from app.parts.scope import Scope
from app.parts.stage import stage
from app.scenes.control import RoadChoice
from app.scenes.road_frame import as_html
from app.theme import learner_label
from tom import readable
from tom.analysis.curves import curve_points
from tom.envs import ROAD
from tom.metrics import describe
from tom.record.reader import RunReader, at_or_before

HEIGHT = 620
SMALL = 360
"""height of a flat map beside others"""
BESIDE = 3
"""maximum number of runs beside the first one"""
TABLE = {
    "weights/road_share": "weight on the road",
    "weights/road_ratio": "road : rocks, random data",
    "model/error_expert": "error, expert",
    "model/error_road": "error, road",
    "model/error_rocks": "error, rocks",
    "planner/return": "planner return",
    "eval/return": "policy return",
    "eval/success": "success",
}
SHARE = "of all data, the expert's too; the road is 30 % of the map"
RATIO = (
    "mean weight on the road over mean weight on the rocks, of the random data alone: the expert's "
    "data, all of it on the road, does not count here"
)


def draw(scope: Scope, run: RunReader, step: int) -> None:
    """A run and a fit, its 3D scene and map, and the numbers of every learner."""
    shown = [one for one in scope.runs if one.env == ROAD and road.steps(one)]
    if run not in shown:
        st.info("This road-and-rocks run has recorded no weights yet.", icon=":material/add_road:")
        return
    st.caption(
        "A car must follow the road; on the rocks steering is turned, differently in every cell. "
        "A linear model cannot be right everywhere: the weights decide where it is."
    )
    others = {one.run_id: one for one in shown if one.run_id != run.run_id}
    called = names(shown)
    beside = address.choose_many(
        "Side by side with", list(others), "beside", called.__getitem__,
        max_selections=BESIDE, placeholder="no other run",
    )  # fmt: skip
    picture = _fit(run, step)
    if picture is None:
        st.warning("This run's map cannot be read.")
        return
    _numbers(run, picture)
    together = [run, *(others[run_id] for run_id in beside)]
    _pictures(together, picture.step)
    _export(together)
    _every_learner(shown)
    for each in others.values():
        # For runs that are only in the table, only the parts that the table needs.
        drawn = each in together
        problems = readers.problems(each) if drawn else readers.metrics_problems(each)
        widgets.show_problems(each, problems)


def _pictures(together: list[RunReader], step: int) -> None:
    """The 3D scene and the map of each run: below it, or beside it for a single run."""
    ids = tuple(each.run_id for each in together)
    if len(together) > 1:
        stage(RoadChoice(ids, step), HEIGHT)
        called = told_apart(together)
        for column, each in zip(st.columns(len(together)), together, strict=True):
            with column, st.container(border=True):
                _flat_map(each, step, SMALL, called[each.run_id])
        return
    left, right = st.columns([5, 4])
    with left:
        stage(RoadChoice(ids, step), HEIGHT)
    with right:
        _flat_map(together[0], step, HEIGHT)


def _every_learner(shown: list[RunReader]) -> None:
    st.markdown("**Every learner**: at the last step that was recorded")
    st.dataframe(comparison(shown), hide_index=True, column_config=_columns())
    st.caption(
        "Errors are root mean squared one-step errors in full steps (the task's noise alone makes "
        "0.07). Planner: value iteration in the learnt model, driven in the real task; policy: SAC "
        "in the learnt model, driven in the real task."
    )


def _flat_map(run: RunReader, step: int, height: int, called: str = "") -> None:
    picture = _fit(run, step)
    if picture is None:
        st.caption(f"The map of {text.markdown(run.run_id)} cannot be read.")
        return
    if called:
        st.markdown(f"**{text.markdown(called)}**, step {picture.step:,}")
    figure = road_map(picture, session.mode(), height)
    words = "mean weight over the map, with road and trajectories"
    chart(figure, f"road map {run.run_id}", words, follow=_over_fits(run))


def _over_fits(run: RunReader) -> Follow:
    """The cells at every fit, which follow the timeline in the browser."""
    found = [(step, picture) for step in road.steps(run) if (picture := road.picture(run, step))]
    return Follow(
        steps=[step for step, _ in found], traces={0: [cells(picture) for _, picture in found]}
    )


def _fit(run: RunReader, step: int) -> Picture | None:
    """A run's record at `step`, else the last one before."""
    return road.picture(run, at_or_before(road.steps(run), step))


def _export(runs: list[RunReader]) -> None:
    """A button that exports the runs' 3D scene with all fits as one HTML file."""
    steps = sorted({step for run in runs for step in road.steps(run)})
    mode = session.mode()

    def page_of_it() -> str:
        fits = [[_fit(run, step) for run in runs] for step in steps]
        return as_html(
            [[p for p in fit if p is not None] for fit in fits if all(fit)],
            mode,
            list(told_apart(runs).values()),
        )

    st.download_button(
        "Share the scene as one HTML file",
        page_of_it,
        file_name="road-and-rocks.html",
        mime="text/html",
        icon=":material/ios_share:",
        on_click="ignore",
        help="opens in any browser, with nothing else beside it: every fit in turn, the cars "
        "drive; some MB",
    )


def comparison(runs: list[RunReader]) -> pd.DataFrame:
    """One row per run: the last value of each number of the claim."""
    rows = []
    for run in runs:
        frame = readers.metrics(run)
        row = {"learner": learner_label(run.learner), "seed": run.seed}
        row |= {name: last_value(frame, metric) for metric, name in TABLE.items()}
        rows.append(row | {"run": run.run_id})
    return pd.DataFrame(rows).sort_values(["learner", "seed"])


def last_value(frame: pd.DataFrame, metric: str, step: int | None = None) -> float:
    """The last recorded value of a metric, at or before `step` if given."""
    at, values = curve_points(frame, metric)
    values = values if step is None else values[at <= step]
    return float(values[-1]) if len(values) else float("nan")


def _numbers(run: RunReader, picture: Picture) -> None:
    frame = readers.metrics(run)
    columns = st.columns(6)

    def show(at: int, label: str, value: float, digits: int, unit: str, words: str) -> None:
        columns[at].metric(label, f"{readable.number(value, digits)}{unit}", help=words)

    columns[0].metric("learner", text.markdown(learner_label(run.learner)))
    recorded = last_value(frame, "weights/road_share", picture.step)
    share = picture.share if np.isfinite(picture.share) else recorded  # a copy without its buffer
    show(1, "weight on the road", 100 * share, 1, " %", SHARE)
    ratio = last_value(frame, "weights/road_ratio", picture.step)
    show(2, "road : rocks, random data", ratio, 1, "", RATIO)
    expert = last_value(frame, "model/error_expert", picture.step)
    show(3, "error, expert data", expert, 2, "", "one-step error in full steps")
    rocks = last_value(frame, "model/error_rocks", picture.step)
    show(4, "error, rocks", rocks, 2, "", "one-step error in full steps")
    score = last_value(frame, "eval/return", picture.step)
    show(5, "policy return", score, 1, "", "mean return of the policy at this step")


def _columns() -> dict:
    number = st.column_config.NumberColumn
    plain = {name: number(name, format="%.3g") for name in TABLE.values()}
    return plain | {
        "weight on the road": number("weight on the road", format="percent"),
        "planner return": number("planner return", format="%.3g", help=describe("planner/return")),
        "success": number("success", format="percent"),
    }
