"""The chosen rows of a buffer as a table, and as a file."""

import numpy as np
import pandas as pd
import streamlit as st

from app.data.buffer import Rows
from app.data.selection import Mask

LISTED = 300
"""maximum number of transitions in the table"""


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
