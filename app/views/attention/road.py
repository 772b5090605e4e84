"""Road and rocks: the weights on the map in 3D and 2D, and the resulting performance."""

import numpy as np
import streamlit as st

from app import session, text
from app.data import readers, road
from app.data.called import names, told_apart
from app.data.road import Picture
from app.figures.road import cells, road_map
from app.parts import address, readout, widgets
from app.parts.plot import Follow, chart
from app.parts.readout import Number
from app.parts.scope import Scope
from app.parts.stage import stage
from app.scenes.control import RoadChoice
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
NUMBERS = {
    "weight on the road": (
        "weights/road_share", "of all data, the expert's too; the road is 30 % of the map",
    ),
    "road : rocks, random data": (
        "weights/road_ratio",
        "mean weight on the road over mean weight on the rocks, of the random data alone: the "
        "expert's data, all of it on the road, does not count here",
    ),
    "error, expert data": ("model/error_expert", "one-step error in full steps"),
    "error, road": ("model/error_road", "one-step error in full steps"),
    "error, rocks": ("model/error_rocks", "one-step error in full steps"),
    "planner return": ("planner/return", describe("planner/return")),
    "policy return": ("eval/return", "mean return of the policy at this step"),
}  # fmt: skip
"""by their label: metric and explanation"""


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
    _numbers(run)
    together = [run, *(others[run_id] for run_id in beside)]
    _pictures(together, picture.step)
    _export(together)
    widgets.link_to("curves", "All runs of this task, side by side")
    for each in together[1:]:
        widgets.show_problems(each)


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
        from app.scenes.road_frame import as_html  # here: viser and trimesh take 0.7 s to import

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


def _numbers(run: RunReader) -> None:
    """What was last measured by each of the run's fits."""
    frame, steps = readers.metrics(run), road.steps(run)
    numbers = []
    for label, (metric, words) in NUMBERS.items():
        at, values = curve_points(frame, metric)
        last = [float(values[at <= step][-1]) if (at <= step).any() else np.nan for step in steps]
        shown = readable.percent if metric == "weights/road_share" else readable.short
        numbers.append(Number(label, [shown(value) for value in last], words))
    readout.readout("numbers", steps, numbers)
