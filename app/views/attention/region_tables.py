"""The content of a region of the replay buffer, in numbers and as a list of transitions."""

import numpy as np
import pandas as pd
import streamlit as st

from app.data import regions
from app.data.buffer import Rows
from app.data.regions import EXPLORED, Mask
from app.figures.regions import apart_bars
from app.parts.plot import chart
from tom import readable
from tom.envs import ROAD
from tom.record.reader import RunReader

LISTED = 300
"""maximum number of transitions in a region's table"""


def contents(run: RunReader, rows: Rows, mask: Mask, names: list[str]) -> None:
    """Numbers of the region and of the whole buffer, and the dimensions that differ most."""
    st.markdown(f"**In the region**: {mask.sum():,} of {len(rows):,} transitions")
    table = summary(rows, mask)
    if run.env == ROAD or not rows.policies_known:  # data of others' policies
        table = table[table[""] != EXPLORED]
    right = {c: st.column_config.TextColumn(c, alignment="right") for c in table.columns[1:]}
    st.dataframe(table, hide_index=True, height="content", column_config=right)
    gaps = regions.apart(rows, mask, names)
    if gaps:
        st.markdown("**What sets it apart**")
        chart(
            apart_bars(gaps, 250, keep=run.run_id),
            "apart",
            "dimensions in which the region differs most",
        )


def summary(rows: Rows, mask: Mask) -> pd.DataFrame:
    """One line per quantity: in the region and in the whole buffer."""
    here, whole = regions.summary(rows, mask), regions.summary(rows, np.ones(len(rows), bool))

    def shown(name: str, value: float) -> str:
        return readable.number(value, 0 if name == "transitions" else 2)

    return pd.DataFrame(
        {
            "": list(here),
            "region": [shown(name, value) for name, value in here.items()],
            "buffer": [shown(name, value) for name, value in whole.items()],
        }
    )


def transitions(rows: Rows, mask: Mask, names: list[str], actions: list[str]) -> None:
    """A table of the heaviest transitions of the region."""
    index = np.flatnonzero(mask)
    index = index[np.argsort(-rows.weight[index], kind="stable")][:LISTED]
    more = f", the {LISTED} heaviest" if mask.sum() > LISTED else ""
    with st.expander(f"Its transitions{more}"):
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
