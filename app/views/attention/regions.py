"""The replay buffer as a map, and the content of a part of it, down to the robot."""

from collections.abc import Mapping, Sequence

import numpy as np
import streamlit as st
from streamlit.delta_generator import DeltaGenerator

from app import session
from app.data import buffer, regions, weighings
from app.data.buffer import Rows
from app.data.regions import Mask, Plane
from app.data.weighings import Dataset
from app.figures.regions import region_map
from app.figures.replay import moments_figure
from app.parts import address, empty, timeline, widgets
from app.parts.plot import Region, chart
from app.parts.scope import Scope
from app.parts.stage import stage
from app.parts.widgets import telling
from app.scenes.control import StatesChoice
from app.theme import learner_label
from app.views.attention import brush, region_tables, why
from app.views.attention.progress import show_notices
from tom.analysis.brush import AS_IT_IS
from tom.envs import ROAD
from tom.record.reader import RunReader, at_or_before
from tom.record.task_record import dimension_names
from tom.reports.weighing_files import called
from tom.spread import spread

MAP_HEIGHT = 690
STAGE_HEIGHT = 560
MOMENT_HEIGHT = 150
"""of one dimension's curves"""
SHOWN = 9
"""number of robots of each kind"""
GAP = 10
"""minimum number of steps between two of them"""
CORNERS = 60
"""maximum number of corners of an outline in an address"""
WEIGHINGS = 3
"""maximum number of weighings, and of brushes, to choose from, the newest"""
OWN = "the run itself"
COMPONENTS = "principal components"
DRAWN, TOP, ZERO, AGE, ALL = "what I draw", "heaviest 1 %", "weight zero", "an age", "everything"


def draw(scope: Scope) -> None:
    """A run and a fit, or weighed data; the map, a region of it, and its content."""
    data = {one.run_id: one for one in weighings.datasets(session.links().store)}
    run = data.get(scope.asked) or scope.one(
        lambda run: bool(run.snapshot_steps()), lambda run: (run.env == ROAD, *telling(run))
    )
    top = st.columns([4, 4, 3, 3], vertical_alignment="bottom")
    if data:
        run = pick_data(top[3], data, run)
    if run is None:
        st.info("No run here has kept its weights yet: they are recorded with the model fits.")
        return
    rows = _pick_weights(run, top[0])
    if rows is None:
        if not empty.left_out(run, "buffer"):
            st.warning("The replay buffer of this fit cannot be read.")
        widgets.show_problems(run)
        return
    names, actions = dimension_names(run.env, rows.rows, buffer.described(run))
    plane = _pick_plane(run, rows, names, top[1:3])
    axes = _axes(run, rows, plane)
    _drop_outline_of_others(axes)
    mask = _pick_region(rows, plane)
    left, right = st.columns([3, 2])
    with left, st.container(border=True):
        _map(run, rows, mask, plane, axes)
    with right, st.container(border=True):
        region_tables.contents(run, rows, mask, names + actions)
    _scenes(run, rows, mask)
    brush.section(run, rows, mask)
    why.section(run, rows)
    region_tables.transitions(rows, mask, names, actions)
    empty.left_out(run, "other snapshots", "simulator states")
    widgets.show_problems(run)


def pick_data(
    place: DeltaGenerator, data: Mapping[str, RunReader], run: RunReader | None
) -> RunReader | None:
    """The run of the list, or a data set that `tom weigh` was given."""
    options = [*([] if run is None else ["the chosen run"]), *data]
    chosen = address.choose_one(place.selectbox, "Buffer of", options, "data", options[0])
    return data.get(chosen, run)


def _pick_weights(run: RunReader, place: DeltaGenerator) -> Rows | None:
    """The buffer with the weights of one of the run's fits, or of a weighing.

    The source of the weights is chosen at `place`, the fit on the timeline.
    """
    length, own = buffer.length(run), [] if isinstance(run, Dataset) else [OWN]
    made, brushes = weighings.of_run(run, length), weighings.brushes(run, length)
    others = {
        f"{learner_label(learner)} s{seed}, {weighing.name}": (weight, weighing)
        for weighing in (*made[:WEIGHINGS], *brushes[:WEIGHINGS])
        for (learner, seed), weight in weighing.weights().items()
        if not (weighing.brush and learner == called(AS_IT_IS))
    }
    options = [*own, *others]
    if not options:
        return None  # its weights cannot be read
    chosen = address.choose_one(
        place.selectbox, "Weights of", options, "weights", options[0],
        help="the run's own fits, or what `tom weigh` or a brush below made of its buffer",
    )  # fmt: skip
    if chosen in others:
        weight, weighing = others[chosen]
        if missing := weighing.missing(length):
            st.caption(missing)
        show_notices(weighing)
        return buffer.weighed_rows(run, weight, weighing.end)
    fits, evaluations = run.snapshot_steps(), run.evaluation_steps()
    step = timeline.chosen(sorted({*fits, *evaluations}))
    timeline.draw(fits, evaluations, step)
    return buffer.rows(run, at_or_before(fits, step))


def _pick_plane(
    run: RunReader, rows: Rows, names: list[str], columns: Sequence[DeltaGenerator]
) -> Plane:
    named = names if len(names) > 1 else []  # two are needed for a plane
    x = columns[0].selectbox(
        "Across", [COMPONENTS, *named], key="across", bind="query-params",
        help="the first two of (s, a, s'), or two dimensions of the state",
    )  # fmt: skip
    if x is None or x == COMPONENTS:
        columns[1].selectbox("Up", ["both are shown"], disabled=True)
        return regions.plane_of(run, rows)
    others = [name for name in names if name != x]
    y = columns[1].selectbox("Up", others, key="up", bind="query-params") or others[0]
    return regions.named_plane(rows.rows, names, x, y)


def _pick_region(rows: Rows, plane: Plane) -> Mask:
    columns = st.columns([5, 3], vertical_alignment="bottom")
    kind = columns[0].segmented_control(
        "Region", [DRAWN, TOP, ZERO, AGE, ALL], default=TOP, required=True, key="region",
        bind="query-params",
    )  # fmt: skip
    if kind == TOP:
        if np.ptp(rows.weight) == 0:
            columns[1].caption("All weights are equal: the region is one in a hundred at random.")
        return regions.heaviest(rows.weight, 0.01)
    if kind == ZERO:
        return rows.weight == 0
    if kind == AGE:
        with columns[1]:
            low, high = st.slider(
                "From the oldest (0 %) to the newest (100 %)", 0, 100, (90, 100), key="age",
                bind="query-params",
            )  # fmt: skip
        return (rows.age >= low) & (rows.age <= high)
    if kind == DRAWN:
        outline = _outline()
        if not outline:
            columns[1].caption("Draw a lasso or a box on the map.")
        return regions.inside(outline, plane.x, plane.y)
    return np.ones(len(rows), bool)


def _outline() -> list[tuple[float, float]]:
    """The corners in the address (`?outline=x,y;x,y;...`); empty if it is malformed."""
    pairs = [pair.split(",") for pair in st.query_params.get("outline", "").split(";")]
    try:
        corners = [(float(x), float(y)) for x, y in pairs]
    except ValueError:
        return []
    return corners if np.isfinite(corners).all() else []


def _axes(run: RunReader, rows: Rows, plane: Plane) -> str:
    """The map's coordinates in words; principal components belong to a single buffer."""
    words = f"{plane.x_name}, {plane.y_name}"
    if st.session_state.get("across") in (None, COMPONENTS):
        words += f" of rows {rows.first} to {rows.first + len(rows)} of {run.run_id}"
    return words


def _drop_outline_of_others(axes: str) -> None:
    """Remove an outline from the address that was drawn on other axes."""
    if "outline" in st.query_params and st.query_params.get("axes", axes) == axes:
        st.query_params["axes"] = axes  # the axes of the outline in the address
        return
    _forget_outline()


def _forget_outline() -> None:
    for name in ("outline", "axes"):
        st.query_params.pop(name, None)


def _map(run: RunReader, rows: Rows, mask: Mask, plane: Plane, axes: str) -> None:
    st.markdown(
        "**The buffer**: a point is a transition, a ring one of the region; draw a lasso or a box"
    )

    def select(region: Region | None) -> None:
        if region is None or len(region.outline) < 3:
            _forget_outline()
            return
        corners = [region.outline[i] for i in spread(len(region.outline), CORNERS)]
        st.query_params["outline"] = ";".join(f"{x:.4g},{y:.4g}" for x, y in corners)
        st.query_params["axes"] = axes
        st.session_state["region"] = DRAWN

    drawn = _outline() if st.session_state.get("region") == DRAWN else []
    keep = f"{run.run_id} {axes}"
    figure = region_map(plane, rows, mask, drawn, session.mode(), MAP_HEIGHT, keep)
    asked = why.clicked(rows, plane)
    label = "the buffer's transitions, coloured by weight"
    chart(figure, "region map", label, clicked=asked, selected=select)


def _scenes(run: RunReader, rows: Rows, mask: Mask) -> None:
    if run.env == ROAD:
        return  # its states are positions on the map, which has its own page
    if not mask.any():
        st.caption("The region is empty: there is nothing to show of it.")
        return
    heavy, light, words = _sides(rows, mask)
    st.markdown(f"**The scenes themselves**: {words}")
    choice = StatesChoice(
        run.run_id,
        tuple(rows.first + row for row in heavy),
        tuple(rows.first + row for row in light),
        tuple(round(float(rows.weight[row]), 4) for row in heavy),
        tuple(round(float(rows.weight[row]), 4) for row in light),
    )
    if not buffer.drawn(run):
        _moments(run, choice)
        return
    stage(choice, STAGE_HEIGHT, compact=True)
    st.caption("A click on the panel's title opens it: there the moments can be played.")


def _moments(run: RunReader, choice: StatesChoice) -> None:
    """Curves of observations around the same transitions, if there is no robot to draw."""
    curves = buffer.moments(run, choice.heavy), buffer.moments(run, choice.light)
    names = buffer.described(run)
    figure = moments_figure(*curves, names, MOMENT_HEIGHT, run.run_id)
    chart(figure, "moments", "observations round the heaviest and the lightest transitions")
    st.caption("Every line is a moment: the transition at 0, and the steps of its episode around.")


def _sides(rows: Rows, mask: Mask) -> tuple[list[int], list[int], str]:
    """The rows on the left and right; a region of one end of the weights is held to the other."""
    kind, whole = st.session_state.get("region"), np.ones(len(rows), bool)
    heavy, light = regions.heavy_and_light(rows, mask, SHOWN, GAP)
    if kind == TOP:
        light = regions.heavy_and_light(rows, whole, SHOWN, GAP)[1]
        return heavy, light, "the region's heaviest on the left, the buffer's lightest on the right"
    if kind == ZERO:
        heavy = regions.heavy_and_light(rows, whole, SHOWN, GAP)[0]
        return heavy, light, "the buffer's heaviest on the left, weight zero on the right"
    return heavy, light, "the region's heaviest on the left, its lightest on the right"
