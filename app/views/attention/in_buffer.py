"""The replay buffer as a map: one selection of its rows, and what they are, down to the robot."""

import io
from collections.abc import Callable, Mapping

import numpy as np
import pandas as pd
import streamlit as st
from streamlit.delta_generator import DeltaGenerator

from app import session, text
from app.data import buffer, buffer_map, weighings
from app.data.buffer import Rows
from app.data.buffer_map import CONTRAST, MODEL, POLICY, PRINCIPAL, TWO, Source
from app.data.columns import RANK, WEIGHT
from app.data.readers import fresh_reader
from app.data.selection import Mask, Selection
from app.data.weighings import Weighing
from app.figures.replay import observation_windows
from app.parts import address, map, widgets
from app.parts.plot import chart
from app.parts.scope import Scope
from app.scenes.control import StatesChoice
from app.theme import BLUE_TO_ORANGE, NEUTRAL, RISING, with_alpha
from app.views.attention import why
from tom.envs import ROAD
from tom.frames import Run, read_weighing
from tom.readable import percent
from tom.record.reader import RunReader, at_or_before
from tom.reports.weighing_files import notices

STAGE_HEIGHT, MOMENT_HEIGHT = 560, 150
SHOWN, GAP = 9, 10
"""robots of each kind, and the minimum number of steps between two of them"""
LISTED = 300
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
    "Two directions of (s, a, s'), standardised. In brackets: the share of the log weights' "
    "variance that the plane's cells explain on held-out rows (0 nothing, 1 all). The plane stays "
    "the same while the timeline moves."
)


def choose(
    scope: Scope,
    place: Callable[[], DeltaGenerator],
    suits: Callable[[RunReader], bool],
    sort_key: Callable[[RunReader], object],
) -> RunReader | None:
    """The run of the list, or a data set that `tom weigh` was given, chosen at `place`."""
    data = {one.run_id: one for one in weighings.datasets(session.links().store)}
    run = data.get(scope.chosen_id) or scope.choose_run(suits, sort_key)
    if not data:
        return run
    options = [*([] if run is None else ["the chosen run"]), *data]
    chosen = address.choose_one(
        place().selectbox, "Buffer of", options, "data", options[0], owner=scope.chosen_id
    )
    return data.get(chosen, run)


def show_remarks(weighing: Weighing, rows: int, *facts: str) -> None:
    """Say of a weighing of a buffer of `rows` what it lacks, contradicts itself in, and noticed."""
    for words in (weighing.missing(rows), *facts):
        if words:
            st.caption(words)
    for notice in notices(weighing.report):
        st.warning(text.markdown(notice), icon=":material/warning:")


def draw(run: RunReader, fit: int) -> None:
    """The map of a run's buffer at a fit, or of a data set; its histograms; the chosen rows."""
    sources = buffer_map.sources(run)
    if not sources:
        if not widgets.show_left_out(run, "buffer", "other snapshots"):
            st.warning(UNREADABLE)
        return
    top = st.columns(3, vertical_alignment="bottom")
    source = _pick_weights(run, sources, fit, top[0])
    rows = buffer.weighed_rows(run, source.weight, source.end)
    if rows is None:
        st.warning(UNREADABLE)
        return
    others = {
        label: f"step {int(label):,}" if label.isdecimal() else label
        for label in sources
        if label != source.label
    }
    against = address.choose_one(
        top[1].selectbox, "Compare with the weights of", [NONE, *others], "against", NONE,
        lambda label: others.get(label, label), disabled=not others,
        help="offered as a colour of the map: how many times the other's weight a row has",
    )  # fmt: skip
    key = _pick_plane(run, sources, source, top[2])
    where, outline = address.get_all("where"), address.get_all("outline")
    selection, row = Selection.of(where, outline), why.chosen_row(run, rows)
    shown = [one for one in sources.values() if not one.weighing]
    given = _map_data(run, rows, source, [source] if source.weighing else shown, row)
    keys = [key, *({selection.outline.plane} - {key} if selection.outline else ())]
    given["planes"] = [plane for one in keys if (plane := buffer_map.plane_for_browser(run, one))]
    beside = sources.get(against)
    given["against"] = buffer_map.source_for_browser(run, beside) if beside else None
    state = st.session_state
    with st.container(border=True):
        map.draw(
            given, 0 if source.weighing else int(source.label), where, outline,
            address.get("colour", WEIGHT.name),
            chosen=lambda where, outline: state.update(where=where, outline=outline),
            picked=why.pick, coloured=lambda name: state.update(colour=[name]),
        )  # fmt: skip
    mask = buffer_map.selection_mask(run, source, selection)
    if run.env != ROAD:  # its states are positions, which its own map shows
        _scenes(run, rows, source, mask, selection, row)
        if run.fits_model and not isinstance(run, weighings.Dataset):  # as `tom brush` needs it
            why.brush(run, source, mask)
    why.draw(run, rows, source, row)
    _row_list(run, rows, source, mask)
    widgets.show_left_out(run, "other snapshots", "simulator states")


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
            st.caption(
                f"The weights of single rows are kept of {len(fits)} fits; this is step {kept:,}."
            )
        return sources[str(kept)]
    if weighing := sources[chosen].weighing:
        show_remarks(weighing, buffer.length(run))
    return sources[chosen]


def _pick_plane(
    run: RunReader, sources: Mapping[str, Source], source: Source, place: DeltaGenerator
) -> str:
    """The key of the shown plane: of another fit until the user asks for this one's."""
    fits = [label for label, one in sources.items() if not one.weighing]
    usual = source.label if source.weighing else fits[-1]
    asked = "".join(address.value_of("of", list)[-1:])
    of = asked if asked in fits and not source.weighing else usual
    keys = {CONTRAST: f"{CONTRAST}@{of}", PRINCIPAL: f"{PRINCIPAL}@{of}"}
    # A network takes a second or more to see all rows, so its share is told once it is chosen.
    shares = {kind: buffer_map.explained_share(run, key, source) for kind, key in keys.items()}
    keys |= buffer_map.network_planes(run)
    names = [one.name for one in buffer_map.dimensions(run)]
    kinds = [*keys, *([TWO] if len(names) > 1 else [])]
    chosen = address.choose_one(
        place.selectbox, "Plane", kinds, "plane", CONTRAST,
        lambda kind: PLANES[kind] + (f" ({shares[kind]:.2f})" if kind in shares else ""),
        help=PLANE_HELP,
    )  # fmt: skip
    caption_place = st
    if chosen == TWO:
        columns = st.columns([4, 4, 7], vertical_alignment="bottom")
        caption_place = columns[2]
        x = address.choose_one(columns[0].selectbox, "Across", names, "across", names[0])
        rest = [name for name in names if name != x]
        y = address.choose_one(columns[1].selectbox, "Up", rest, "up", rest[0])
        keys[TWO] = f"{TWO}@{x}|{y}"
    address.write("of", [] if of == usual or chosen not in shares else [of])
    if chosen not in shares:
        share = buffer_map.explained_share(run, keys[chosen], source)
        if not np.isfinite(share):
            st.caption("This network cannot be read; the plane shown is where weights differ most.")
            return keys[CONTRAST]
        caption_place.caption(f"It explains {percent(share, 0)} of the variance of the log weight.")
    elif of != source.label:
        row = st.container(horizontal=True, vertical_alignment="center")
        row.caption(f"The plane is that of step {int(of):,}, so that only the weights move.")
        if row.button("Plane of this fit"):
            st.session_state["of"] = [source.label]
            st.rerun()
    return keys[chosen]


def _map_data(
    run: RunReader, rows: Rows, source: Source, shown: list[Source], row: int | None
) -> dict[str, object]:
    """What the map needs to know of the buffer, of the `shown` weights, and of a chosen row."""
    mode, near, path = session.mode(), [], None
    if row is not None:
        near = buffer_map.nearest(run, source, rows.first + row).tolist()
        same = np.flatnonzero(rows.episode == rows.episode[row])
        path = [rows.first + int(same[0]), rows.first + int(same[-1])]
    return {
        "columns": buffer_map.columns_for_browser(run, shown),
        "sources": [buffer_map.source_for_browser(run, one) for one in shown],
        "row": None if row is None else rows.first + row,
        "path": path,
        "near": near,
        "mode": mode,
        "diverging": BLUE_TO_ORANGE[mode],
        "sequential": RISING[mode],
        "colours": {
            "all": with_alpha(NEUTRAL, 0.45), "chosen": with_alpha("#4a7fd0", 0.6),
            "weight": BLUE_TO_ORANGE[mode][-2][1], "brush": with_alpha(NEUTRAL, 0.2),
            "edge": NEUTRAL,
        },
    }  # fmt: skip


def _scenes(
    run: RunReader, rows: Rows, source: Source, mask: Mask, selection: Selection, row: int | None
) -> None:
    """Robots of the chosen rows; or of a row and of its nearest."""
    kinds = ["the chosen rows", "a row and its nearest"]
    kind = kinds[0]
    if row is not None:
        kind = address.choose_part(kinds, "scenes", "Scenes")
    if row is None or kind == kinds[0]:
        if not mask.any():
            st.caption("No row is chosen, so there is no scene to show.")
            return
        left, right = buffer.heavy_and_light(rows, mask, SHOWN, GAP)
        titles = "heaviest", "lightest"
        words = "the heaviest chosen on the left, the lightest chosen on the right"
        # Rows of one end of the weights are held to the other.
        whole = np.ones(len(rows), bool)
        if RANK.name in selection.intervals:
            right = buffer.heavy_and_light(rows, whole, SHOWN, GAP)[1]
            words = "the heaviest chosen on the left, the buffer's lightest on the right"
        elif selection.intervals.get(WEIGHT.name) == (None, 0):
            left = buffer.heavy_and_light(rows, whole, SHOWN, GAP)[0]
            words = "the buffer's heaviest on the left, weight zero on the right"
    else:
        near = buffer_map.nearest(run, source, rows.first + row) - rows.first
        left, right, titles = [row], near.tolist()[:SHOWN], ("the row", "its nearest")
        words = "the row on the left, its nearest on the right"
    st.markdown(f"**The scenes themselves**: {words}")
    groups = tuple(
        (
            title,
            tuple(rows.first + at for at in side),
            tuple(float(f"{rows.weight[at]:.6g}") for at in side),
        )
        for title, side in zip(titles, (left, right), strict=True)
    )
    if buffer.has_robot(run):
        widgets.show_scene(StatesChoice(str(run.home), groups), STAGE_HEIGHT)
        st.caption("Click the panel's title to open it and play the moments.")
        return
    heavy, light = (buffer.observations_around(run, numbers) for _, numbers, _ in groups)
    figure = observation_windows(
        heavy, light, buffer.observation_names(run), MOMENT_HEIGHT, run.run_id
    )
    chart(figure, "moments", "observations round the heaviest and the lightest transitions")
    st.caption(
        "There is no robot to draw. Every line is a moment: the transition at 0, and the steps of "
        "its episode around."
    )


def _row_list(run: RunReader, rows: Rows, source: Source, mask: Mask) -> None:
    """The heaviest chosen rows, listed when they are asked for; all of them as a file."""
    more = f", the {LISTED} heaviest" if mask.sum() > LISTED else ""
    box = address.fold(f"The chosen transitions{more}", "rows")
    if box.open:
        index = np.flatnonzero(mask)
        index = index[np.argsort(-rows.weight[index], kind="stable")][:LISTED]
        box.dataframe(row_table(run, rows, index), hide_index=True, alt="The chosen transitions")

    def content() -> bytes:
        file = io.BytesIO()
        table(run, source)[mask].to_parquet(file, index=False)
        return file.getvalue()

    which = "all" if mask.all() else "the chosen"
    st.download_button(
        f"Save {which} {int(mask.sum()):,} rows (Parquet)", content,
        f"{run.run_id.replace('/', '-')}-rows-{source.end}.parquet",
        "application/vnd.apache.parquet", icon=":material/download:", on_click="ignore",
        key="save rows", help="opens in pandas, DuckDB and Embedding Atlas; see docs/runs.md",
    )  # fmt: skip


def table(run: RunReader, source: Source) -> pd.DataFrame:
    """The rows of these weights, a line each: `tom.load(...).rows(...)`."""
    if source.weighing is None:
        return Run(fresh_reader(run)).rows(int(source.label))
    return read_weighing(source.weighing.path).rows(source.column)


def row_table(run: RunReader, rows: Rows, index: np.ndarray) -> pd.DataFrame:
    """One line for each of these rows: its weight, its origin, s, a, r and s'."""
    part = rows.rows[index].numpy()
    names, actions = buffer.obs_and_action_names(run)
    table = {
        "weight": rows.weight[index],
        "row": rows.first + index,
        "episode": rows.episode[index],
        "step of the episode": rows.episode_step[index] + 1,
        "return of the episode": rows.episode_return[index],
        "policy version": rows.version[index]
        if buffer.policies_known(rows.version)
        else "not known",
        "reward": part.reward,
        "terminal": np.asarray(part.terminated) != 0,
    }
    vectors = (
        (part.obs, names),
        (part.action, actions),
        (part.next_obs, [f"next {n}" for n in names]),
    )
    for values, columns in vectors:
        table |= dict(zip(columns, np.asarray(values).T, strict=True))
    return pd.DataFrame(table)
