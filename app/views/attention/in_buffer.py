"""The replay buffer as a map: one selection of its rows, and what they are, down to the robot."""

from collections.abc import Mapping

import numpy as np
import streamlit as st
from streamlit.delta_generator import DeltaGenerator

from app import session
from app.data import buffer, buffer_map, regions, weighings
from app.data.buffer import Rows
from app.data.buffer_map import CONTRAST, MODEL, POLICY, PRINCIPAL, TWO, Source
from app.data.columns import RANK, WEIGHT
from app.data.selection import Mask, Selection
from app.data.weighings import Dataset
from app.figures.replay import moments_figure
from app.parts import address, empty, map, timeline, widgets
from app.parts.plot import chart
from app.parts.scope import Scope
from app.parts.stage import stage
from app.parts.widgets import telling
from app.scenes.control import StatesChoice
from app.theme import BLUE_TO_ORANGE, NEUTRAL, RISING, faded
from app.views.attention import brush, region_tables, why
from app.views.attention.progress import show_notices
from tom.envs import ROAD
from tom.record.reader import RunReader, at_or_before
from tom.record.task_record import dimension_names

STAGE_HEIGHT = 560
MOMENT_HEIGHT = 150
"""of one dimension's curves"""
SHOWN = 9
"""number of robots of each kind"""
GAP = 10
"""minimum number of steps between two of them"""
OWN, NONE = "the run itself", "no other"
PLANES = {
    CONTRAST: "where weights differ most",
    PRINCIPAL: "principal components",
    POLICY: "as the policy sees it",
    MODEL: "as the model sees it",
    TWO: "two dimensions",
}
PLANE_HELP = (
    "Two directions of (s, a, s'), standardised. In brackets the share of the log weights that the "
    "plane's cells explain on rows held out: 0 is nothing, 1 all. The plane stays while the "
    "timeline moves."
)


def draw(scope: Scope) -> None:
    """A run and a fit, or weighed data; the map and its histograms, and the chosen rows."""
    data = {one.run_id: one for one in weighings.datasets(session.links().store)}
    run = data.get(scope.asked) or scope.one(
        lambda run: bool(run.snapshot_steps()), lambda run: (run.env == ROAD, *telling(run))
    )
    top = st.columns([4, 4, 4, 3], vertical_alignment="bottom")
    if data:
        run = pick_data(top[3], data, run)
    if run is None:
        st.info("No run here has kept its weights yet: they are recorded with the model fits.")
        return
    sources = buffer_map.sources(run)
    source = _pick_weights(run, sources, top[0]) if sources else None
    rows = buffer_map.rows(run, source) if source else None
    if source is None or rows is None:
        if not empty.left_out(run, "buffer"):
            st.warning("The replay buffer of this fit cannot be read.")
        widgets.show_problems(run)
        return
    against = _pick_against(sources, source, top[1])
    key = _pick_plane(run, sources, source, top[2])
    selection, row = _selection(), why.asked(rows)
    mask = buffer_map.chosen(run, source, selection)
    with st.container(border=True):
        _map(run, rows, source, key, against, row)
    names, actions = dimension_names(run.env, rows.rows, buffer.described(run))
    _scenes(run, rows, source, mask, selection, row)
    brush.section(run, rows, mask)
    why.section(run, rows)
    region_tables.transitions(rows, mask, names, actions)
    region_tables.save(run, source, mask)
    empty.left_out(run, "other snapshots", "simulator states")
    widgets.show_problems(run)


def pick_data(
    place: DeltaGenerator, data: Mapping[str, RunReader], run: RunReader | None
) -> RunReader | None:
    """The run of the list, or a data set that `tom weigh` was given."""
    options = [*([] if run is None else ["the chosen run"]), *data]
    chosen = address.choose_one(place.selectbox, "Buffer of", options, "data", options[0])
    return data.get(chosen, run)


def _pick_weights(
    run: RunReader, sources: Mapping[str, Source], place: DeltaGenerator
) -> Source | None:
    """The weights of one of the run's fits, or of a weighing.

    The source of the weights is chosen at `place`, the fit on the timeline.
    """
    made = [label for label, source in sources.items() if source.weighing]
    own = [] if isinstance(run, Dataset) or len(made) == len(sources) else [OWN]
    options = [*own, *made]
    chosen = address.choose_one(
        place.selectbox, "Weights of", options, "weights", options[0],
        help="the run's own fits, or what `tom weigh` or a brush below made of its buffer",
    )  # fmt: skip
    if chosen != OWN:
        source = sources[chosen]
        if source.weighing is not None:
            if missing := source.weighing.missing(buffer.length(run)):
                st.caption(missing)
            show_notices(source.weighing)
        return source
    fits = [int(label) for label, source in sources.items() if not source.weighing]
    evaluations = run.evaluation_steps()
    step = timeline.chosen(sorted({*fits, *evaluations}))
    timeline.draw(fits, evaluations, step)
    return sources[str(at_or_before(fits, step))]


def _pick_against(
    sources: Mapping[str, Source], source: Source, place: DeltaGenerator
) -> Source | None:
    """Other weights of the buffer, with which the map compares these."""
    others = [label for label in sources if label != source.label]
    shown = {label: f"step {int(label):,}" if label.isdecimal() else label for label in others}
    chosen = address.choose_one(
        place.selectbox, "Compare with the weights of", [NONE, *others], "against", NONE,
        lambda label: shown.get(label, label), disabled=not others,
        help="offered as a colour of the map: how many times the other's weight a row has",
    )  # fmt: skip
    return sources.get(chosen)


def _pick_plane(
    run: RunReader, sources: Mapping[str, Source], source: Source, place: DeltaGenerator
) -> str:
    """The key of the shown plane: of another fit until the user asks for this one's."""
    usual = (
        source.label
        if source.weighing
        else [s.label for s in sources.values() if not s.weighing][-1]
    )
    of = address.value_of("of", lambda words: "".join(words[-1:]) or None) or usual
    if of not in sources or bool(sources[of].weighing) != bool(source.weighing):
        of = usual
    if source.weighing:
        of = source.label
    keys = {CONTRAST: f"{CONTRAST}@{of}", PRINCIPAL: f"{PRINCIPAL}@{of}"}
    # A network takes a second or more to see all rows, so its share is told once it is chosen.
    shares = {kind: buffer_map.explained(run, key, source) for kind, key in keys.items()}
    keys |= buffer_map.layers(run)
    names = [one.name for one in buffer_map.dimensions(run)]
    kinds = [*keys, *([TWO] if len(names) > 1 else [])]
    first = TWO if run.env == ROAD and TWO in kinds else CONTRAST
    chosen = address.choose_one(
        place.selectbox, "Plane", kinds, "plane", first,
        lambda kind: PLANES[kind] + (f" ({shares[kind]:.2f})" if kind in shares else ""),
        help=PLANE_HELP,
    )  # fmt: skip
    if chosen == TWO:
        columns = st.columns([4, 4, 7], vertical_alignment="bottom")
        x = address.choose_one(columns[0].selectbox, "Across", names, "across", names[0])
        rest = [name for name in names if name != x]
        y = address.choose_one(columns[1].selectbox, "Up", rest, "up", rest[0])
        share = buffer_map.explained(run, f"{TWO}@{x}|{y}", source)
        columns[2].caption(f"It explains {share:.2f} of the log weights on rows held out.")
        return f"{TWO}@{x}|{y}"
    if chosen not in shares:
        share = buffer_map.explained(run, keys[chosen], source)
        if not np.isfinite(share):
            st.caption("This network cannot be read: the plane is where weights differ most.")
            return keys[CONTRAST]
        st.caption(f"It explains {share:.2f} of the log weights on rows held out.")
    if chosen in shares and of != source.label:
        row = st.container(horizontal=True, vertical_alignment="center")
        row.caption(f"The plane is that of step {int(of):,}, so that what moves are the weights.")
        if row.button("Plane of this fit"):
            of = source.label
            st.session_state["of"] = of
            st.rerun()
    address.keep("of", [] if of == usual or chosen not in (CONTRAST, PRINCIPAL) else [of])
    return keys[chosen]


def _selection() -> Selection:
    """What is chosen; at first the heaviest hundredth."""
    where = address.value_of("where", list)
    outline = address.value_of("outline", list)
    address.keep("where", where)
    address.keep("outline", outline)
    return Selection.of(where, outline)


def _map(
    run: RunReader, rows: Rows, source: Source, key: str, against: Source | None, row: int | None
) -> None:
    where, outline = st.session_state["where"], st.session_state["outline"]
    selection = Selection.of(where, outline)
    of_outline = [selection.outline.plane] if selection.outline else []
    keys = dict.fromkeys([key, *of_outline])
    planes = [plane for one in keys if (plane := buffer_map.given_plane(run, one))]
    own = [s for s in buffer_map.sources(run).values() if not s.weighing]
    shown = [source] if source.weighing else own
    mode = session.mode()
    episode = None
    if row is not None:
        same = np.flatnonzero(rows.episode == rows.episode[row])
        episode = [rows.first + int(same[0]), rows.first + int(same[-1])]
    given = {
        "columns": buffer_map.given_columns(run),
        "sources": [buffer_map.given_source(run, one) for one in shown],
        "planes": planes,
        "against": buffer_map.given_source(run, against) if against else None,
        "row": None if row is None else rows.first + row,
        "path": episode,
        "near": [] if row is None else buffer_map.nearest(run, source, rows.first + row).tolist(),
        "mode": mode,
        "diverging": BLUE_TO_ORANGE[mode],
        "sequential": RISING[mode],
        "colours": {
            "all": faded(NEUTRAL, 0.45), "chosen": faded("#4a7fd0", 0.6),
            "weight": BLUE_TO_ORANGE[mode][-2][1], "brush": faded(NEUTRAL, 0.2), "edge": NEUTRAL,
        },
    }  # fmt: skip
    colour = "".join(address.value_of("colour", list)[-1:]) or WEIGHT.name
    address.keep("colour", [] if colour == WEIGHT.name else [colour])
    map.draw(
        given, source.end, where, outline, colour,
        chosen=_choose, picked=why.pick,
        coloured=lambda name: st.session_state.update(colour=[name]),
    )  # fmt: skip


def _choose(where: list[str], outline: list[str]) -> None:
    st.session_state["where"], st.session_state["outline"] = where, outline


def _scenes(
    run: RunReader, rows: Rows, source: Source, mask: Mask, selection: Selection, row: int | None
) -> None:
    """Robots of the chosen rows; or of a row and of its nearest."""
    if run.env == ROAD:
        return  # its states are positions on the map, which has its own page
    if not mask.any() and row is None:
        st.caption("No row is chosen: there is nothing to show of it.")
        return
    sides = ["the chosen rows", "a row and its nearest"]
    kind = sides[0]
    if row is not None:
        kind = address.choose_one(
            st.segmented_control, "Scenes", sides, "scenes", sides[0], required=True,
            label_visibility="collapsed",
        )  # fmt: skip
    if kind == sides[0]:
        left, right, words = _sides(rows, mask, selection)
        titles = "heaviest", "lightest"
    else:
        assert row is not None
        near = buffer_map.nearest(run, source, rows.first + row) - rows.first
        left, right, words = (
            [row],
            near.tolist()[:SHOWN],
            "the row on the left, its nearest on the right",
        )
        titles = "the row", "its nearest"
    st.markdown(f"**The scenes themselves**: {words}")
    choice = StatesChoice(
        run.run_id,
        tuple(rows.first + at for at in left),
        tuple(rows.first + at for at in right),
        tuple(round(float(rows.weight[at]), 4) for at in left),
        tuple(round(float(rows.weight[at]), 4) for at in right),
        titles,
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
    st.caption(
        "There is no robot to draw. Every line is a moment: the transition at 0, and the steps of "
        "its episode around."
    )


def _sides(rows: Rows, mask: Mask, selection: Selection) -> tuple[list[int], list[int], str]:
    """The rows on the left and right; rows of one end of the weights are held to the other."""
    whole = np.ones(len(rows), bool)
    heavy, light = regions.heavy_and_light(rows, mask, SHOWN, GAP)
    if RANK.name in selection.intervals:
        light = regions.heavy_and_light(rows, whole, SHOWN, GAP)[1]
        return heavy, light, "the heaviest chosen on the left, the buffer's lightest on the right"
    if selection.intervals.get(WEIGHT.name) == (None, 0):
        heavy = regions.heavy_and_light(rows, whole, SHOWN, GAP)[0]
        return heavy, light, "the buffer's heaviest on the left, weight zero on the right"
    return heavy, light, "the heaviest chosen on the left, the lightest chosen on the right"
