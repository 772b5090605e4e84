"""The rows of a buffer as one table: where each is in its episode, its weight, its coordinates."""

from collections.abc import Mapping

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from tom.analysis import planes
from tom.data.transitions import Transitions, episodes

FIELDS = ("obs", "action", "reward", "next_obs", "terminated", "truncated")


def transition_table(rows: Transitions) -> pd.DataFrame:
    """One row per transition; a vector has one column per dimension: `obs_0`, `obs_1`, ..."""
    part = rows.numpy()
    columns: dict[str, NDArray] = {}
    for name in FIELDS:
        values = np.asarray(getattr(part, name))
        if values.ndim == 1:
            columns[name] = values != 0 if name in ("terminated", "truncated") else values
        else:
            columns |= {f"{name}_{i}": values[:, i] for i in range(values.shape[1])}
    return pd.DataFrame(columns)


def row_table(
    record: Transitions,
    weight: NDArray,
    end: int,
    names: planes.Names,
    more: Mapping[str, NDArray] | None = None,
) -> pd.DataFrame:
    """The N rows before row `end` of a record, with weights (N,), and `more` columns (N,).

    `row` and `episode` count the whole record, `age` is in % of the N rows, 0 the oldest. The
    coordinates are those of `planes`, of these rows and weights; `names` are those of the O and A
    dimensions of observations and actions.
    """
    count, first = len(weight), end - len(weight)
    whole = record.numpy()
    rows = whole[first:end]
    episode, place, _ = episodes(whole)
    coordinates = {
        "contrast": planes.of_rows(planes.contrast_of(rows, weight, names), rows),
        "pc": planes.of_rows(planes.principal_of(rows, names), rows),
    }
    return pd.concat(
        [
            pd.DataFrame(
                {
                    "row": np.arange(first, end),
                    "episode": episode[first:end],
                    "episode_step": place[first:end],
                    "age": (np.arange(count) + 0.5) * 100 / max(count, 1),
                }
            ),
            transition_table(rows),
            pd.DataFrame(
                {"weight": np.asarray(weight, np.float32)}
                | {f"{kind}_{i}": xy[:, i] for kind, xy in coordinates.items() for i in (0, 1)}
                | dict(more or {})
            ),
        ],
        axis=1,
    )
