"""The counterfactual brush: what if this region of the buffer had counted more or less?"""

from collections.abc import Sequence
from pathlib import Path
from tempfile import NamedTemporaryFile
from threading import Thread

import numpy as np
import streamlit as st

from app import session, text
from app.data import buffer, trainings, weighings
from app.data.buffer_map import Source
from app.data.selection import Mask
from app.data.weighings import Brushed
from app.figures.why import NAMES, change, error_bars, factor_in_words
from app.parts.plot import chart
from app.scenes.film import ghosts
from app.views.attention import progress
from tom.analysis.brush import FACTORS
from tom.envs import is_code
from tom.record.reader import RunReader
from tom.record.task_record import scene_of

HEIGHT = 380
KEY = "brush"
BEGUN = "brush begun"
"""the process that this section started, in the session"""


def section(run: RunReader, source: Source, mask: Mask) -> None:
    """Start a brush of the region, and show earlier ones."""
    brushes = weighings.brushes(run, buffer.length(run))
    regions = {one.name: one for one in map(weighings.brushed, brushes) if one is not None}
    with st.container(border=True):
        st.markdown("**What if this region counted more, or less?**")
        _start(run, source, mask)
        progress.show(BEGUN, chosen=KEY)
        if not regions:
            return
        chosen = st.selectbox(
            "Brushed", list(regions), key=KEY, bind="query-params",
            help="newest first; its weights can be chosen above under Weights of",
        )  # fmt: skip
        _shown(run, regions.get(chosen or "", next(iter(regions.values()))))


def command(
    run_id: str, rows: str, step: int, of: str, factors: Sequence[float], store: str
) -> list[str]:
    """The arguments of `tom` that brush the rows listed in a file."""
    weights = ["--weighing", of] if of else []
    by = [f"{factor:g}" for factor in factors]
    return [
        "brush", run_id, "--rows", rows, "--step", str(step), *weights, "--factors", *by,
        "--store", store,
    ]  # fmt: skip


def _start(run: RunReader, source: Source, mask: Mask) -> None:
    count = int(mask.sum())
    columns = st.columns([3, 2], vertical_alignment="bottom")
    factors = columns[0].pills(
        "Its weight is multiplied by", list(FACTORS), default=list(FACTORS), key="factors",
        selection_mode="multi", format_func=factor_in_words,
    )  # fmt: skip
    if why := _why_not(run, count, len(mask)):
        st.caption(why)
        return
    if columns[1].button(
        f"Fit small models: {count:,} transitions", key="brush it", disabled=not factors,
        type="primary", width="stretch",
    ):  # fmt: skip
        with NamedTemporaryFile("w", prefix="tom-brush-", suffix=".txt", delete=False) as file:
            np.savetxt(file, source.first + np.flatnonzero(mask), fmt="%d")
        store = session.links().store
        words = command(run.argument, file.name, source.end, source.option, factors, store)
        begun = st.session_state[BEGUN] = trainings.start(words)

        def remove() -> None:  # when its reader has ended, whether or not a page looks on
            begun.process.wait()
            Path(file.name).unlink(missing_ok=True)

        Thread(target=remove, daemon=True).start()


def _why_not(run: RunReader, count: int, of: int) -> str:
    if why := session.read_only_reason():
        return why
    if is_code(run.env):
        words = text.markdown(f"tom brush {run.argument} --env {run.env} --rows FILE --step N")
        return f"It runs code of yours, so it is started in a terminal: {words}"
    return "" if 0 < count < of else "Choose some rows of the buffer above, not all of them."


def _shown(run: RunReader, brushed: Brushed) -> None:
    left, right = st.columns([1, 1])
    with left:
        st.markdown(f"**{brushed.rows:,} of {brushed.of:,} transitions, step {brushed.step:,}**")
        figure = error_bars(brushed, HEIGHT, session.mode())
        chart(figure, "brush errors", "errors of brushed models by region")
        st.caption(in_words(brushed))
    with right:
        kept = [f for f in brushed.factors if f"x{f:g}" in brushed.ghosts]
        if not kept:
            st.caption("No ghosts: no evaluation episode was kept.")
            return
        factor = st.segmented_control(
            "Ghost of weight", kept, default=kept[0], required=True, key="ghost of",
            format_func=factor_in_words,
        )  # fmt: skip
        factor = kept[0] if factor not in kept else factor
        name = f"region {factor_in_words(factor)}"
        known, model = buffer.described_task(run), scene_of(run)
        if known is None or model is None:
            st.caption("No ghosts: there is no robot to draw.")
            return
        page = ghosts((known, model), brushed.ghosts, factor, name, run.learner, session.mode())
        st.iframe(page, height=HEIGHT)
        st.caption(
            "An evaluation episode, and what two models make of its actions, from the real state "
            "every 20 steps; at a quarter of real time."
        )


def in_words(brushed: Brushed) -> str:
    """The change of the models' errors, one sentence per factor."""
    said = []
    for factor in brushed.factors:
        parts = []
        for region, name in NAMES.items():
            ratio = change(brushed, region, factor) if region in brushed.errors else np.array([])
            ratio = ratio[np.isfinite(ratio)]
            if not len(ratio):
                continue
            sure = (ratio > 1).all() or (ratio < 1).all()
            parts.append(f"{name} {100 * (ratio.mean() - 1):+.0f} %{'' if sure else ' (not all)'}")
        said.append(f"Weight {factor_in_words(factor)}: {', '.join(parts)}.")
    size = f"{brushed.model['layers']} layers of {brushed.model['hidden']} units"
    return text.markdown(
        f"{' '.join(said)} Not all: the seeds do not agree on the sign. Models of {size}, errors "
        "one step ahead against those by the weights as they are."
    )
