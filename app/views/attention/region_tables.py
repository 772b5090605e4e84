"""The chosen rows of a buffer as a table, and as a file."""

import io
from contextlib import suppress

import numpy as np
import pandas as pd
import streamlit as st
from numpy.typing import NDArray

from app.data import buffer
from app.data.buffer import Rows
from app.data.buffer_map import Source
from app.data.readers import reader
from app.data.selection import Mask
from tom.analysis.imagine import step_errors, stored_model
from tom.analysis.row_table import row_table
from tom.errors import UserError
from tom.frames import Run
from tom.record.reader import RunReader
from tom.record.task_record import dimension_names

LISTED = 300
"""maximum number of transitions in the table"""


def save(run: RunReader, source: Source, mask: Mask) -> None:
    """A button that saves the chosen rows, or all, with all that is known of them."""

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
    """The rows of these weights, a line each; of a fit they are `tom.load(run).rows(step)`."""
    if source.weighing is None:
        return Run(reader(run)).rows(int(source.label))
    record = buffer.recorded(run).rows
    named = dimension_names(run.env, record, buffer.described(run))
    more: dict[str, NDArray] = {}
    with suppress(UserError):  # it kept no model
        rows = record[source.first : source.end]
        more["error"] = step_errors(stored_model(run).predictor, rows)
    return row_table(record, source.weight, source.end, named, more)


def transitions(rows: Rows, mask: Mask, names: list[str], actions: list[str]) -> None:
    """A table of the heaviest chosen transitions."""
    index = np.flatnonzero(mask)
    index = index[np.argsort(-rows.weight[index], kind="stable")][:LISTED]
    more = f", the {LISTED} heaviest" if mask.sum() > LISTED else ""
    with st.expander(f"The chosen transitions{more}"):
        st.dataframe(listed(rows, index, names, actions), hide_index=True)


def listed(rows: Rows, index: np.ndarray, names: list[str], actions: list[str]) -> pd.DataFrame:
    """One line for each of these rows: its weight, its origin, s, a, r and s'."""
    part = rows.rows[index].numpy()
    table = {
        "weight": rows.weight[index],
        "row": rows.first + index,
        "episode": rows.episode[index] + 1,  # counted as on the map
        "step of the episode": rows.place[index] + 1,
        "return of the episode": rows.episode_return[index],
        "policy version": rows.version[index] if rows.policies_known else "not known",
        "reward": part.reward,
        "terminal": np.asarray(part.terminated) != 0,
    }
    obs, action, following = (np.asarray(x) for x in (part.obs, part.action, part.next_obs))
    table |= {name: obs[:, i] for i, name in enumerate(names)}
    table |= {name: action[:, i] for i, name in enumerate(actions)}
    table |= {f"next {name}": following[:, i] for i, name in enumerate(names)}
    return pd.DataFrame(table)
