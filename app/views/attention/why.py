"""Why this weight, and what if this region counted more or less: a row's terms, and the brush."""

from collections.abc import Sequence
from pathlib import Path
from tempfile import NamedTemporaryFile
from weakref import finalize

import numpy as np
import pandas as pd
import streamlit as st

from app import session, text
from app.data import buffer, weighings
from app.data import why as reasons
from app.data.buffer import Rows
from app.data.buffer_map import Source
from app.data.selection import Mask
from app.data.weighings import Brushed
from app.data.why import Why
from app.figures.why import NAMES, brushed_errors, factor_text, rollout_lines, waterfall
from app.parts import address, jobs, widgets
from app.parts.plot import chart
from app.scenes.film import ghost_film
from tom.analysis.brush import FACTORS
from tom.envs import ROAD, is_code
from tom.learners import SUBJECT, learner_label
from tom.readable import number, percent, score, short
from tom.record.reader import RunReader
from tom.record.task_record import scene_of

KEY = "row"
HEIGHT, BRUSH_HEIGHT = 290, 380
FORMULA = {
    "chi2": "max(0, 1 + sum)",
    "full-chi2": "max(0, 1 + sum / 2)",
    "kl": "exp(sum)",
}
FLOWS = {
    "discounted": "discounted, as printed in the paper",
    "restart": "restart: an end is followed by a new start",
    "stationary": "stationary: g = 1, an end is followed by a new start, the mean weight is 1",
}


def pick(row: int) -> None:
    """Choose the transition with this number in the run's record."""
    st.session_state[KEY] = row


def chosen_row(run: RunReader, rows: Rows) -> int | None:
    """The chosen row of the buffer: by a click, a widget or the address (`?row=`); or none.

    A row that this fit's buffer does not hold stays chosen for other fits.
    """
    row = address.value_of(KEY, address.whole_number)
    if row is None or not 0 <= row < buffer.length(run):
        st.session_state[KEY] = None
        return None
    return row - rows.first if rows.first <= row < rows.first + len(rows) else None


def draw(run: RunReader, rows: Rows, source: Source, row: int | None) -> None:
    with st.container(border=True):
        _row_picker(run, rows)
        if row is None:
            return
        found = reasons.why_of(run, source)
        numbers = {
            "weight": number(float(rows.weight[row]), 3),
            "heavier than": percent(float((rows.weight < rows.weight[row]).mean())),
            "its step in its episode": f"{rows.episode_step[row] + 1:,}",
            "return of that episode": score(float(rows.episode_return[row])),
            "ends the episode": "yes" if rows.rows.numpy().ended()[row] else "no",
        }
        widgets.metrics(numbers, {"heavier than": "of the buffer"})
        if isinstance(found, str):
            st.info(f"No sum: {text.markdown(found)}.", icon=":material/functions:")
            _offer_weighing(run, source.step)
        else:
            left, right = st.columns([3, 2])
            with left:
                st.markdown("**The sum**")
                summed = found.sum_of(row)
                figure = waterfall(summed, SUBJECT, HEIGHT)
                chart(figure, "why sum", "the terms that make the weight")
                config, raw = found.config, summed.raw
                mean = f" / {short(summed.mean)} (its mean over the buffer)"
                formula = FORMULA[config.divergence].replace("sum", short(summed.argument))
                formula += "." if config.divergence == "kl" else f"{mean}."
                g = 1.0 if config.flow == "stationary" else config.discount
                cut = " The sum lies below the cut, so the weight is zero." if raw == 0 else ""
                sentence = (
                    f"{short(summed.weight)} = {formula}{cut} Divergence {config.divergence}, flow "
                    f"{FLOWS[config.flow]}; g = {g:g}. Terms of {found.origin}."
                )
                st.caption(text.markdown(sentence))
            with right:
                if len(found.policy_rows):
                    _neighbours(run, rows, found, row)
                else:
                    st.caption("Its policy is code of yours, which is run only in a terminal.")
        if run.env != ROAD:
            _rollouts(run, rows, row, source.step)


def _row_picker(run: RunReader, rows: Rows) -> None:
    st.markdown("**Why this weight?** Click a transition on a map, or choose one")
    weight = rows.weight
    zero, above = np.flatnonzero(weight == 0), np.flatnonzero(weight > 0)
    suggested = {
        "heaviest": len(weight) - 1 - int(weight[::-1].argmax()),  # the newest of equals
        "average": above[np.abs(weight[above] - 1).argmin()] if len(above) else None,
        "zero": zero[len(zero) // 2] if len(zero) else None,
        "newest": len(rows) - 1,
    }
    with st.container(horizontal=True, vertical_alignment="bottom"):
        chosen = st.number_input(
            "Number of the transition", 0, buffer.length(run) - 1, value=None, key=KEY,
            placeholder="none yet", width=260,
            help="its row in the run's record, counted from 0",
        )  # fmt: skip
        for name, row in suggested.items():
            at = rows.first + int(row or 0)
            st.button(name, key=f"why {name}", disabled=row is None, on_click=pick, args=(at,))
    address.write(KEY, [] if chosen is None else [str(chosen)])
    last = rows.first + len(rows) - 1
    if chosen is not None and not rows.first <= chosen <= last:
        st.caption(f"This buffer holds the transitions {rows.first:,} to {last:,}.")


def _neighbours(run: RunReader, rows: Rows, found: Why, row: int) -> None:
    near = reasons.neighbours(rows, found, row)
    st.markdown("**Its nearest of the policy's own transitions**")
    names, actions = buffer.obs_and_action_names(run)
    obs, action = np.asarray(near.rows.obs), np.asarray(near.rows.action)
    own = np.concatenate([np.asarray(rows.rows.obs)[row], np.asarray(rows.rows.action)[row]])
    table = pd.DataFrame({"": [*names, *actions], "this one": own})
    for i, distance in enumerate(near.near.distance.tolist()):
        # Several may lie equally far, to two places.
        table[f"{i + 1}: at {distance:.2f}"] = np.concatenate([obs[i], action[i]])
    numbers = {c: st.column_config.NumberColumn(c, format="%.2f") for c in table.columns[1:]}
    st.dataframe(table, hide_index=True, height=240, column_config=numbers, alt="Its nearest")
    first = float(near.near.distance[0])
    st.caption(
        f"Distances in standard deviations over (s, a, s' - s). The nearest of the policy's "
        f"{len(found.policy_rows):,} transitions is {first:.2f} away. The median is "
        f"{near.usual:.2f} over the buffer's other rows, and {near.own:.2f} from one of the "
        f"policy's own to the nearest other."
    )


def _rollouts(run: RunReader, rows: Rows, row: int, step: int | None) -> None:
    st.markdown("**The rollouts that start there**")
    starts = reasons.starts(run, rows, row)
    if starts is not None:
        here, usual = starts
        st.caption(
            f"About {here:,.2f} of each round's rollouts start in this state; {usual:,.2f} would "
            "at weight 1."
            if here > 0
            else "No rollout starts in this state."
        )
    rollouts = reasons.rollouts(run, rows, row, step)
    if isinstance(rollouts, str):
        st.caption(f"No rollouts: {text.markdown(rollouts)}.")
        return
    paths = rollouts.paths
    names, _ = buffer.obs_and_action_names(run)
    moved = paths[:, 1].std(0) / np.maximum(np.asarray(rows.rows.obs).std(0), 1e-9)
    first = int(np.nan_to_num(moved).argmax())
    name = st.selectbox("Dimension", names, index=first, key="why dimension")
    i = names.index(name or names[first])
    recorded = reasons.recorded_after(rows, row)[:, i]
    figure = rollout_lines(paths[:, :, i], recorded, names[i], run.learner, HEIGHT)
    chart(figure, "why rollouts", "rollouts of the policy in the model from this state")
    by = "" if rollouts.own else ", by the run's last policy (this fit's was not kept)"
    st.caption(
        f"{len(paths)} rollouts in the model of step {rollouts.model_step:,}, the last model that "
        f"the run kept{by}."
    )


def _offer_weighing(run: RunReader, step: int | None) -> None:
    """Offer to weigh the buffer of this step again, with its terms.

    Not where that would run code of the user's, which a page never starts.
    """
    if run.env == ROAD or is_code(run.env) or step not in run.policy_steps():
        return
    words = ["weigh", run.argument, "--policy", run.argument, "--step", str(step)]
    words += ["--learner", SUBJECT, "--seeds", "0", "--store", session.links().store]
    st.caption(
        "To get the terms, weigh the buffer again with this fit's policy and the run's settings, "
        "then choose them above, under Weights of. Its Q begins afresh, so the weights differ from "
        "the run's own."
    )
    job = f"Weighing {run.run_id} at {step}"
    if why := session.read_only_reason():
        st.caption(why)
    elif st.button(
        f"Weigh this buffer by {learner_label(SUBJECT)}", key="why weigh",
        disabled=jobs.is_running(job),
    ):  # fmt: skip
        jobs.start(job, words)
    jobs.show(job)


def brush(run: RunReader, source: Source, mask: Mask) -> None:
    """Start a brush of the chosen region, and show earlier ones."""
    brushes = weighings.of_run(run, brush=True)
    regions = {one.name: one for one in map(weighings.brushed, brushes) if one is not None}
    with st.container(border=True):
        st.markdown("**What if this region counted more, or less?**")
        job = f"Brush of {run.run_id}"
        _brush_form(job, run, source, mask)
        # The newest is then shown, in place of an earlier one that was chosen.
        jobs.show(job, lambda: st.session_state.update(brush=""))
        if regions:
            chosen = address.choose_one(
                st.selectbox, "Brushed", list(regions), "brush", next(iter(regions)),
                help="newest first; its weights can be chosen above under Weights of",
            )  # fmt: skip
            _brushed(run, regions[chosen])


def brush_arguments(
    run_id: str, rows: str, step: int, weights_option: str, factors: Sequence[float], store: str
) -> list[str]:
    """The arguments of `tom` that brush the rows listed in a file."""
    weights = ["--weighing", weights_option] if weights_option else []
    by = [f"{factor:g}" for factor in factors]
    return [
        "brush", run_id, "--rows", rows, "--step", str(step), *weights, "--factors", *by,
        "--store", store,
    ]  # fmt: skip


def _brush_form(job: str, run: RunReader, source: Source, mask: Mask) -> None:
    left, right = st.columns([3, 2], vertical_alignment="bottom")
    factors = left.pills(
        "Multiply its weight by", list(FACTORS), default=list(FACTORS), key="factors",
        selection_mode="multi", format_func=factor_text,
    )  # fmt: skip
    count = int(mask.sum())
    if why := session.read_only_reason():
        st.caption(why)
    elif is_code(run.env):
        words = text.markdown(f"tom brush {run.argument} --env {run.env} --rows FILE --step N")
        st.caption(f"This runs code of yours, so start it in a terminal: {words}")
    elif not 0 < count < len(mask):
        st.caption("Choose some rows of the buffer above, not all of them.")
    elif right.button(
        f"Fit small models: {count:,} transitions", key="brush it", type="primary", width="stretch",
        disabled=not factors or jobs.is_running(job),
    ):  # fmt: skip
        with NamedTemporaryFile("w", prefix="tom-brush-", suffix=".txt", delete=False) as file:
            np.savetxt(file, source.first + np.flatnonzero(mask), fmt="%d")
        store = session.links().store
        step = source.end if source.step is None else source.step
        if source.step is None and run.own_loop:  # whose steps are those handed in
            step = int(buffer.recorded(run).version[: source.end].max())
        words = brush_arguments(run.argument, file.name, step, source.option, factors, store)
        # The file goes with the record of its reader, or with the studio.
        finalize(jobs.start(job, words), Path(file.name).unlink, missing_ok=True)


def _brushed(run: RunReader, brushed: Brushed) -> None:
    left, right = st.columns([1, 1])
    with left:
        st.markdown(
            f"**{brushed.rows:,} of {brushed.buffer_rows:,} transitions, step {brushed.step:,}**"
        )
        figure = brushed_errors(brushed, BRUSH_HEIGHT, session.mode())
        chart(figure, "brush errors", "errors of brushed models by region")
        st.caption(error_changes(brushed))
    with right:
        kept = [f for f in brushed.factors if f"x{f:g}" in brushed.ghosts]
        if not kept:
            st.caption("No ghosts: no evaluation episode was kept.")
            return
        factor = st.segmented_control(
            "Ghost of weight", kept, default=kept[0], required=True, key="ghost of",
            format_func=factor_text,
        )  # fmt: skip
        factor = kept[0] if factor not in kept else factor
        task, model = buffer.find_task(run), scene_of(run)
        if task is None or model is None:
            st.caption("No ghosts: there is no robot to draw.")
            return
        name, robot = f"region {factor_text(factor)}", (task, model)
        page = ghost_film(robot, brushed.ghosts, factor, name, run.learner, session.mode())
        st.iframe(page, height=BRUSH_HEIGHT, alt="Ghosts of two models")
        st.caption(
            "An evaluation episode at a quarter of real time, and its prediction by two models, "
            "which restart from the real state every 20 steps."
        )


def error_changes(brushed: Brushed) -> str:
    """The change of the models' errors, one sentence per factor."""
    sentences = []
    for factor in brushed.factors:
        parts = []
        for region, name in NAMES.items():
            ratio = brushed.change(region, factor)
            ratio = ratio[np.isfinite(ratio)]
            if not len(ratio):
                continue
            sure = (ratio > 1).all() or (ratio < 1).all()
            parts.append(f"{name} {100 * (ratio.mean() - 1):+.0f} %{'' if sure else ' (not all)'}")
        sentences.append(f"Weight {factor_text(factor)}: {', '.join(parts)}.")
    size = f"{brushed.model['layers']} layers of {brushed.model['hidden']} units"
    return text.markdown(
        f"{' '.join(sentences)} Not all: the seeds disagree on the sign. Models of {size}; "
        "one-step errors, compared with those under unchanged weights."
    )
