"""Road and rocks: the weights on the map in 3D and 2D, and the resulting performance."""

from collections.abc import Sequence

import numpy as np
import streamlit as st

from app import session, text
from app.data import readers, road
from app.data.called import names, told_apart
from app.data.road import Picture
from app.figures.road import cells, road_map
from app.parts import address, timeline, widgets
from app.parts.plot import Follow, chart
from app.parts.scope import Scope
from app.scenes.control import RoadChoice
from tom import readable
from tom.analysis.curves import curve_points
from tom.envs import ROAD
from tom.metrics import describe
from tom.record.reader import RunReader, at_or_before

HEIGHT, SMALL_HEIGHT = 620, 360
MOST_BESIDE = 3
ERROR = "one-step error in full steps"
NUMBERS = {
    "weight on the road": (
        "weights/road_share", "of all data, the expert's too; the road is 30 % of the map",
    ),
    "road : rocks, random data": (
        "weights/road_ratio",
        "mean weight on the road over mean weight on the rocks, of the random data alone: the "
        "expert's data, all of it on the road, does not count here",
    ),
    "error, expert data": ("model/error_expert", ERROR),
    "error, road": ("model/error_road", ERROR),
    "error, rocks": ("model/error_rocks", ERROR),
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
    beside = address.choose_many(
        "Side by side with", list(others), "beside", names(shown).__getitem__,
        max_selections=MOST_BESIDE, placeholder="no other run",
    )  # fmt: skip
    picture = _fit(run, step)
    if picture is None:
        st.warning("This run's map cannot be read.")
        return
    _numbers(run)
    runs = [run, *(others[run_id] for run_id in beside)]
    choice = RoadChoice(tuple(each.run_id for each in runs), picture.step)
    called = told_apart(runs)
    if len(runs) > 1:
        widgets.stage(choice, HEIGHT)
        for column, each in zip(st.columns(len(runs)), runs, strict=True):
            with column, st.container(border=True):
                _flat_map(each, picture.step, SMALL_HEIGHT, called[each.run_id])
    else:
        left, right = st.columns([5, 4])
        with left:
            widgets.stage(choice, HEIGHT)
        with right:
            _flat_map(run, picture.step, HEIGHT)
    _export(runs, list(called.values()))
    widgets.link_to("curves", "All runs of this task, side by side")
    for each in runs[1:]:
        widgets.show_problems(each)


def _fit(run: RunReader, step: int) -> Picture | None:
    """A run's record at `step`, else the last one before."""
    return road.picture(run, at_or_before(road.steps(run), step))


def _flat_map(run: RunReader, step: int, height: int, called: str = "") -> None:
    """The map, whose cells follow the timeline in the browser."""
    picture = _fit(run, step)
    if picture is None:
        st.caption(f"The map of {text.markdown(run.run_id)} cannot be read.")
        return
    if called:
        st.markdown(f"**{text.markdown(called)}**, step {picture.step:,}")
    of_step = {at: found for at in road.steps(run) if (found := road.picture(run, at))}
    chart(
        road_map(picture, session.mode(), height), f"road map {run.run_id}",
        "mean weight over the map, with road and trajectories",
        follow=Follow(steps=list(of_step), trace=[cells(found) for found in of_step.values()]),
    )  # fmt: skip


def _export(runs: Sequence[RunReader], called: list[str]) -> None:
    """A button that exports the runs' 3D scene with all fits as one HTML file."""
    mode = session.mode()

    def page_of_it() -> str:
        from app.scenes.road import as_html  # here: viser and trimesh take 0.7 s to import

        steps = sorted({step for run in runs for step in road.steps(run)})
        fits = [[_fit(run, step) for run in runs] for step in steps]
        whole = [[one for one in fit if one is not None] for fit in fits if all(fit)]
        return as_html(whole, mode, called)

    st.download_button(
        "Share the scene as one HTML file", page_of_it, "road-and-rocks.html", "text/html",
        icon=":material/ios_share:", on_click="ignore",
        help="opens in any browser, with nothing else beside it: every fit in turn, the cars "
        "drive; some MB",
    )  # fmt: skip


def _numbers(run: RunReader) -> None:
    """What was last measured by each of the run's fits."""
    frame, steps = readers.metrics(run), road.steps(run)
    numbers = []
    for label, (metric, words) in NUMBERS.items():
        at, values = curve_points(frame, metric)
        last = [float(values[at <= step][-1]) if (at <= step).any() else np.nan for step in steps]
        shown = readable.percent if metric == "weights/road_share" else readable.short
        numbers.append((label, [shown(value) for value in last], words))
    timeline.numbers(steps, numbers)
