"""Arrays and tables of a run's files, to and from the backend's types.

Wrong content raises an error of `tom.data.unpack.DAMAGE`.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from tom.data.transitions import BEHAVIOUR, Transitions
from tom.data.unpack import read_columns
from tom.events import Collected, Episode

Arrays = Mapping[str, NDArray]

NUMBERS = {"use_dictionary": False, "use_byte_stream_split": True}
"""how columns of floating-point numbers are written; other types are refused with it"""


def read_table(path: Path) -> pd.DataFrame:
    """The columns of a Parquet file. Raises one of DAMAGE."""
    # Not by pandas: it would read hive partitions from the folder's name, and its conversion from
    # Arrow takes twice as long, which matters in a store of 200 runs.
    read, _ = read_columns(path)
    return pd.DataFrame({name: read[name].to_numpy() for name in read.column_names})


def write_table(where: Path | BinaryIO, table: pa.Table, **more: Any) -> None:
    """Write a Parquet file, compressed, with checksums by which a reader finds a changed bit."""
    pq.write_table(table, where, compression="zstd", write_page_checksum=True, **more)


def episode_arrays(episodes: Sequence[Episode]) -> dict[str, NDArray]:
    arrays: dict[str, NDArray] = {}
    for i, episode in enumerate(episodes):
        parts = {"reward": episode.reward, "action": episode.action, "obs": episode.obs}
        parts |= {"qpos": episode.qpos, "qvel": episode.qvel}
        arrays |= {f"{name}_{i}": part for name, part in parts.items() if part is not None}
        arrays[f"ended_{i}"] = np.array([episode.terminated, episode.truncated])
        arrays |= {
            f"info_{i}.{name}": np.array(value, np.float64) for name, value in episode.info.items()
        }
    return arrays


def episodes_of(arrays: Arrays) -> list[Episode]:
    """The episodes in `episodes/<step>.npz`."""
    episodes = []
    for i in range(sum(name.startswith("reward_") for name in arrays)):
        prefix = f"info_{i}."
        terminated, truncated = (bool(flag) for flag in arrays[f"ended_{i}"])
        episode = Episode(
            reward=arrays[f"reward_{i}"],
            action=arrays[f"action_{i}"],
            obs=arrays[f"obs_{i}"],
            qpos=arrays.get(f"qpos_{i}"),
            qvel=arrays.get(f"qvel_{i}"),
            terminated=terminated,
            truncated=truncated,
            info={n[len(prefix) :]: float(arrays[n]) for n in arrays if n.startswith(prefix)},
        )
        episodes.append(episode)
    return episodes


STATE = "state_"
"""prefix of the arrays of the simulator's state in `buffer/<first row>.npz`"""


def transition_arrays(collected: Collected) -> dict[str, NDArray]:
    """The arrays of `buffer/<first row>.npz`: float32, flags as booleans."""
    rows = collected.transitions
    arrays = {f.name: np.asarray(getattr(rows, f.name), np.float32) for f in fields(rows)}
    arrays |= {name: arrays[name] != 0 for name in ("terminated", "truncated")}
    arrays |= {STATE + name: np.asarray(a, np.float32) for name, a in collected.state.items()}
    if collected.behaviour is not None:
        parts = np.split(np.asarray(collected.behaviour, np.float32), 2, axis=1)
        arrays |= dict(zip(BEHAVIOUR, parts, strict=True))
    return arrays | {"policy_version": np.asarray(collected.policy_version, np.int64)}


def transitions_of(arrays: Arrays) -> tuple[Transitions, NDArray[np.int64]]:
    """The rows and policy versions in `buffer/<first row>.npz`."""
    whole = {**arrays}
    if "jump" in arrays:  # as `without_next_obs` left them
        whole["next_obs"] = np.concatenate([arrays["obs"][1:], arrays["obs"][-1:]])
        whole["next_obs"][arrays["jump"]] = arrays["jump_obs"]
    parts = (whole[f.name] for f in fields(Transitions))
    # The buffer of a small copy is in half precision.
    rows = Transitions(*(a.astype(np.float32) if a.dtype == np.float16 else a for a in parts))
    return rows, arrays["policy_version"]


def without_next_obs(arrays: Arrays) -> dict[str, NDArray]:
    """The arrays of `buffer/<first row>.npz` at little more than half the size, without loss.

    Instead of `next_obs` there are `jump` (K,), the rows whose next observation is not that of the
    following row (the last of every episode), and `jump_obs` (K, O), their next observations.
    """
    obs, next_obs = arrays["obs"], arrays["next_obs"]
    kept = {name: array for name, array in arrays.items() if name != "next_obs"}
    chained = np.append((obs[1:] == next_obs[:-1]).all(1), False)
    jump = np.flatnonzero(~chained[: len(obs)]).astype(np.int32)
    return kept | {"jump": jump, "jump_obs": next_obs[jump]}


@dataclass(frozen=True)
class Profiles:
    """The profiles of F model fits (`tom.data.sampling.bin_means`).

    In runs recorded before 2026-11-22 bins have whole rows, and NaN if there are none.
    """

    env_step: NDArray[np.int64]  # (F,)
    bins: NDArray[np.float64]  # (F, bins)
    count: NDArray[np.int64]  # (F,) transitions in the buffer
    ess: NDArray[np.float64]  # (F,) effective sample size as a share of the buffer
    zeros: NDArray[np.float64]  # (F,) share of transitions with weight zero
    rows: NDArray[np.int64]  # (F,) rows recorded so far; the buffer is the newest `count` of them

    def rows_at(self, step: int) -> int:
        """The rows recorded at the fit of `step`; without such a fit each step adds a row."""
        found = self.rows[self.env_step == step]
        return int(found[-1]) if len(found) else step


def profiles_of(rows: Sequence[Mapping[str, Any]]) -> Profiles:
    """The profiles in the rows of `weights/profiles.jsonl`; null becomes NaN."""
    bins = np.array([row["bins"] for row in rows], np.float64)
    return Profiles(
        env_step=np.array([row["env_step"] for row in rows], np.int64),
        bins=bins.reshape(len(rows), -1 if rows else 0),
        count=np.array([row["count"] for row in rows], np.int64),
        ess=np.array([row["ess"] for row in rows], np.float64),
        zeros=np.array([row["zeros"] for row in rows], np.float64),
        # Older runs on data that is complete from the first step on do not say how much it is.
        rows=np.array([r.get("rows", max(r["env_step"], r["count"])) for r in rows], np.int64),
    )


def metrics_table(rows: Sequence[Mapping[str, Any]]) -> pd.DataFrame:
    """The table of metric rows: `env_step` as int64, every metric as float64, null as NaN.

    Rows of the same step are merged; for a metric in several of them the last one counts.
    """
    merged: dict[int, dict[str, float]] = {}
    names: dict[str, None] = {}
    for row in rows:
        if isinstance(step := row.get("env_step"), int):
            values = {name: value for name, value in row.items() if name != "env_step"}
            names |= dict.fromkeys(values)
            merged.setdefault(step, {}).update(
                (name, float(value))
                for name, value in values.items()
                if value is not None and math.isfinite(value)
            )
    values = [[merged[step].get(name, np.nan) for name in names] for step in sorted(merged)]
    table = pd.DataFrame(
        np.array(values, np.float64).reshape(len(merged), len(names)), columns=[*names]
    )
    table.insert(0, "env_step", np.array(sorted(merged), np.int64))
    return table
