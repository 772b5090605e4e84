"""The chosen rows of a buffer as a table, and as a file."""

import io

import numpy as np
import pandas as pd
import streamlit as st

from app.data import buffer_map
from app.data.buffer import Rows
from app.data.buffer_map import Source
from app.data.readers import reader
from app.data.selection import Mask
from tom.frames import Run, read_weighing
from tom.record.reader import RunReader

LISTED = 300
"""maximum number of transitions in the table"""


def section(run: RunReader, rows: Rows, source: Source, mask: Mask) -> None:
    """The heaviest chosen rows, listed when they are asked for; all of them as a file."""
    more = f", the {LISTED} heaviest" if mask.sum() > LISTED else ""
    box = st.expander(
        f"The chosen transitions{more}", key="rows", on_change="rerun", bind="query-params"
    )
    with box:
        if box.open:
            index = np.flatnonzero(mask)
            index = index[np.argsort(-rows.weight[index], kind="stable")][:LISTED]
            st.dataframe(listed(run, rows, index), hide_index=True)

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
        return Run(reader(run)).rows(int(source.label))
    return read_weighing(source.weighing.path).rows(source.column)


def listed(run: RunReader, rows: Rows, index: np.ndarray) -> pd.DataFrame:
    """One line for each of these rows: its weight, its origin, s, a, r and s'."""
    part = rows.rows[index].numpy()
    names, actions = buffer_map.named(run)
    table = {
        "weight": rows.weight[index],
        "row": rows.first + index,
        "episode": rows.episode[index] + 1,
        "step of the episode": rows.place[index] + 1,
        "return of the episode": rows.episode_return[index],
        "policy version": rows.version[index] if rows.policies_known else "not known",
        "reward": part.reward,
        "terminal": np.asarray(part.terminated) != 0,
    }
    vectors = (
        (part.obs, names),
        (part.action, actions),
        (part.next_obs, [f"next {n}" for n in names]),
    )
    for values, called in vectors:
        table |= dict(zip(called, np.asarray(values).T, strict=True))
    return pd.DataFrame(table)
