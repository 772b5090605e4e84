"""The replay buffer as a map: one selection of its rows, and what they are, down to the robot."""

from collections.abc import Mapping

import numpy as np
import streamlit as st
from streamlit.delta_generator import DeltaGenerator

from app import session
from app.data import buffer, buffer_map
from app.data.buffer import Rows
from app.data.buffer_map import CONTRAST, MODEL, POLICY, PRINCIPAL, TWO, Source
from app.data.columns import RANK, WEIGHT
from app.data.selection import Mask, Selection
from app.figures.replay import moments_figure
from app.parts import address, empty, map
from app.parts.plot import chart
from app.parts.stage import stage
from app.scenes.control import StatesChoice
from app.theme import BLUE_TO_ORANGE, NEUTRAL, RISING, faded
from app.views.attention import brush, row_list, why
from app.views.attention.progress import show_notices
from tom.envs import ROAD
from tom.record.reader import RunReader, at_or_before

STAGE_HEIGHT = 560
MOMENT_HEIGHT = 150
"""of one dimension's curves"""
SHOWN = 9
"""number of robots of each kind"""
GAP = 10
"""minimum number of steps between two of them"""
UNREADABLE = "The rows of this buffer, or their weights, were not kept or cannot be read."
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


def draw(run: RunReader, fit: int) -> None:
    """The map of a run's buffer at a fit, or of a data set; its histograms; the chosen rows."""
    sources = buffer_map.sources(run)
    if not sources:
        if not empty.left_out(run, "buffer", "other snapshots"):
            st.warning(UNREADABLE)
        return
    top = st.columns(3, vertical_alignment="bottom")
    source = _pick_weights(run, sources, fit, top[0])
    rows = buffer_map.rows(run, source)
    if rows is None:
        st.warning(UNREADABLE)
        return
    against = _pick_against(sources, source, top[1])
    key = _pick_plane(run, sources, source, top[2])
    where, outline = address.value_of("where", list), address.value_of("outline", list)
    address.keep("where", where)
    address.keep("outline", outline)
    selection, row = Selection.of(where, outline), why.asked(rows)
    with st.container(border=True):
        _map(run, rows, sources, source, key, against, row)
    mask = buffer_map.chosen(run, source, selection)
    if run.env != ROAD:  # its states are positions, which its own map shows
        _scenes(run, rows, source, mask, selection, row)
        brush.section(run, source, mask)
    why.section(run, rows, source)
    row_list.section(run, rows, source, mask)
    empty.left_out(run, "other snapshots", "simulator states")


def pick_data(
    place: DeltaGenerator, data: Mapping[str, RunReader], run: RunReader | None
) -> RunReader | None:
    """The run of the list, or a data set that `tom weigh` was given."""
    options = [*([] if run is None else ["the chosen run"]), *data]
    chosen = address.choose_one(place.selectbox, "Buffer of", options, "data", options[0])
    return data.get(chosen, run)


def _pick_weights(
    run: RunReader, sources: Mapping[str, Source], fit: int, place: DeltaGenerator
) -> Source:
    """The weights of the last fit up to `fit` that kept them, or those of a weighing."""
    made = [label for label, source in sources.items() if source.weighing]
    fits = [int(label) for label, source in sources.items() if not source.weighing]
    options = [*([OWN] if fits else []), *made]
    chosen = address.choose_one(
        place.selectbox, "Weights of", options, "weights", options[0],
        help="the run's own fits, or what `tom weigh` or a brush below made of its buffer",
    )  # fmt: skip
    if chosen == OWN:
        kept = at_or_before(fits, fit)
        if kept != fit:
            st.caption(f"Single weights are kept of {len(fits)} fits; below is step {kept:,}.")
        return sources[str(kept)]
    weighing = sources[chosen].weighing
    assert weighing is not None
    if missing := weighing.missing(buffer.length(run)):
        st.caption(missing)
    show_notices(weighing)
    return sources[chosen]


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
    fits = [label for label, one in sources.items() if not one.weighing]
    usual = source.label if source.weighing else fits[-1]
    asked = address.value_of("of", lambda words: "".join(words[-1:]))
    of = asked if asked in fits and not source.weighing else usual
    keys = {CONTRAST: f"{CONTRAST}@{of}", PRINCIPAL: f"{PRINCIPAL}@{of}"}
    # A network takes a second or more to see all rows, so its share is told once it is chosen.
    shares = {kind: buffer_map.explained(run, key, source) for kind, key in keys.items()}
    keys |= buffer_map.layers(run)
    names = [one.name for one in buffer_map.dimensions(run)]
    kinds = [*keys, *([TWO] if len(names) > 1 else [])]
    chosen = address.choose_one(
        place.selectbox, "Plane", kinds, "plane", CONTRAST,
        lambda kind: PLANES[kind] + (f" ({shares[kind]:.2f})" if kind in shares else ""),
        help=PLANE_HELP,
    )  # fmt: skip
    told = st
    if chosen == TWO:
        columns = st.columns([4, 4, 7], vertical_alignment="bottom")
        told = columns[2]
        x = address.choose_one(columns[0].selectbox, "Across", names, "across", names[0])
        rest = [name for name in names if name != x]
        y = address.choose_one(columns[1].selectbox, "Up", rest, "up", rest[0])
        keys[TWO] = f"{TWO}@{x}|{y}"
    address.keep("of", [] if of == usual or chosen not in shares else [of])
    if chosen not in shares:
        share = buffer_map.explained(run, keys[chosen], source)
        if not np.isfinite(share):
            st.caption("This network cannot be read: the plane is where weights differ most.")
            return keys[CONTRAST]
        told.caption(f"It explains {share:.2f} of the log weights on rows held out.")
    elif of != source.label:
        row = st.container(horizontal=True, vertical_alignment="center")
        row.caption(f"The plane is that of step {int(of):,}, so that what moves are the weights.")
        if row.button("Plane of this fit"):
            st.session_state["of"] = source.label
            st.rerun()
    return keys[chosen]


def _map(
    run: RunReader,
    rows: Rows,
    sources: Mapping[str, Source],
    source: Source,
    key: str,
    against: Source | None,
    row: int | None,
) -> None:
    where, outline = st.session_state["where"], st.session_state["outline"]
    selection = Selection.of(where, outline)
    keys = [key, *({selection.outline.plane} - {key} if selection.outline else ())]
    own = [one for one in sources.values() if not one.weighing]
    shown, mode = [source] if source.weighing else own, session.mode()
    near, path = [], None
    if row is not None:
        near = buffer_map.nearest(run, source, rows.first + row).tolist()
        same = np.flatnonzero(rows.episode == rows.episode[row])
        path = [rows.first + int(same[0]), rows.first + int(same[-1])]
    given = {
        "columns": buffer_map.given_columns(run, shown),
        "sources": [buffer_map.given_source(run, one) for one in shown],
        "planes": [plane for one in keys if (plane := buffer_map.given_plane(run, one))],
        "against": buffer_map.given_source(run, against) if against else None,
        "row": None if row is None else rows.first + row,
        "path": path,
        "near": near,
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
    state = st.session_state
    map.draw(
        given, source.end, where, outline, colour,
        chosen=lambda where, outline: state.update(where=where, outline=outline),
        picked=why.pick, coloured=lambda name: state.update(colour=[name]),
    )  # fmt: skip


def _scenes(
    run: RunReader, rows: Rows, source: Source, mask: Mask, selection: Selection, row: int | None
) -> None:
    """Robots of the chosen rows; or of a row and of its nearest."""
    if not mask.any() and row is None:
        st.caption("No row is chosen: there is nothing to show of it.")
        return
    kinds = ["the chosen rows", "a row and its nearest"]
    kind = kinds[0]
    if row is not None:
        kind = address.choose_one(
            st.segmented_control, "Scenes", kinds, "scenes", kinds[0], required=True,
            label_visibility="collapsed",
        )  # fmt: skip
    if row is None or kind == kinds[0]:
        left, right, words = _sides(rows, mask, selection)
        titles = "heaviest", "lightest"
    else:
        near = buffer_map.nearest(run, source, rows.first + row) - rows.first
        left, right, titles = [row], near.tolist()[:SHOWN], ("the row", "its nearest")
        words = "the row on the left, its nearest on the right"
    st.markdown(f"**The scenes themselves**: {words}")
    choice = StatesChoice(
        run.run_id,
        tuple(rows.first + at for at in left),
        tuple(rows.first + at for at in right),
        tuple(round(float(rows.weight[at]), 4) for at in left),
        tuple(round(float(rows.weight[at]), 4) for at in right),
        titles,
    )
    if buffer.drawn(run):
        stage(choice, STAGE_HEIGHT, compact=True)
        st.caption("A click on the panel's title opens it: there the moments can be played.")
        return
    curves = buffer.moments(run, choice.heavy), buffer.moments(run, choice.light)
    figure = moments_figure(*curves, buffer.described(run), MOMENT_HEIGHT, run.run_id)
    chart(figure, "moments", "observations round the heaviest and the lightest transitions")
    st.caption(
        "There is no robot to draw. Every line is a moment: the transition at 0, and the steps of "
        "its episode around."
    )


def _sides(rows: Rows, mask: Mask, selection: Selection) -> tuple[list[int], list[int], str]:
    """The rows on the left and right; rows of one end of the weights are held to the other."""
    whole = np.ones(len(rows), bool)
    heavy, light = buffer.heavy_and_light(rows, mask, SHOWN, GAP)
    if RANK.name in selection.intervals:
        light = buffer.heavy_and_light(rows, whole, SHOWN, GAP)[1]
        return heavy, light, "the heaviest chosen on the left, the buffer's lightest on the right"
    if selection.intervals.get(WEIGHT.name) == (None, 0):
        heavy = buffer.heavy_and_light(rows, whole, SHOWN, GAP)[0]
        return heavy, light, "the buffer's heaviest on the left, weight zero on the right"
    return heavy, light, "the heaviest chosen on the left, the lightest chosen on the right"
