"""Convert arrays on disk to the backend's types. Wrong content raises ValueError or KeyError."""

from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any, TypeGuard

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from tom.data.transitions import Transitions
from tom.events import Episode
from tom.record.profiles import Profiles
from tom.record.status import HUGE

Arrays = Mapping[str, NDArray]

LARGEST = float(np.finfo(np.float64).max)


def episode_arrays(episodes: Sequence[Episode]) -> dict[str, NDArray]:
    """The arrays of `episodes/<step>.npz`."""
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
    count = sum(name.startswith("reward_") for name in arrays)
    return [_episode(arrays, i) for i in range(count)]


def _episode(arrays: Arrays, i: int) -> Episode:
    prefix = f"info_{i}."
    info = {n.removeprefix(prefix): float(arrays[n]) for n in arrays if n.startswith(prefix)}
    terminated, truncated = (bool(flag) for flag in arrays[f"ended_{i}"])
    return Episode(
        reward=arrays[f"reward_{i}"],
        action=arrays[f"action_{i}"],
        obs=arrays[f"obs_{i}"],
        qpos=arrays.get(f"qpos_{i}"),
        qvel=arrays.get(f"qvel_{i}"),
        terminated=terminated,
        truncated=truncated,
        info=info,
    )


STATE = "state_"
"""prefix of the arrays of the simulator's state in `buffer/<first row>.npz`"""


def transition_arrays(
    rows: Transitions, policy_version: NDArray, state: Arrays | None = None
) -> dict[str, NDArray]:
    """The arrays of `buffer/<first row>.npz`: float32, flags as booleans."""
    arrays = {f.name: np.asarray(getattr(rows, f.name), np.float32) for f in fields(rows)}
    arrays |= {name: arrays[name] != 0 for name in ("terminated", "truncated")}
    arrays |= {STATE + name: np.asarray(a, np.float32) for name, a in (state or {}).items()}
    return arrays | {"policy_version": np.asarray(policy_version, np.int64)}


def state_of(arrays: Arrays) -> dict[str, NDArray]:
    """The simulator's states in `buffer/<first row>.npz`, if the run stored them.

    Raises ValueError if they are not as many as its rows.
    """
    length = len(arrays["policy_version"])
    state = {n.removeprefix(STATE): arrays[n] for n in arrays if n.startswith(STATE)}
    if any(len(array) != length for array in state.values()):
        raise ValueError("its states and its rows differ in number")
    return state


def transitions_of(arrays: Arrays) -> tuple[Transitions, NDArray[np.int64]]:
    """The rows and policy versions in `buffer/<first row>.npz`.

    Raises ValueError if its arrays differ in length.
    """
    whole = {"next_obs": _following(arrays), **arrays} if "jump" in arrays else arrays
    rows = Transitions(*(_single(whole[f.name]) for f in fields(Transitions)))
    version = arrays["policy_version"]
    sizes = {len(getattr(rows, f.name)) for f in fields(rows)} | {len(version)}
    if len(sizes) != 1:
        raise ValueError("its arrays differ in length")
    return rows, version


def without_next_obs(arrays: Arrays) -> dict[str, NDArray]:
    """The arrays of `buffer/<first row>.npz` at little more than half the size, without loss.

    Instead of `next_obs` there are `jump` (K,), the rows whose next observation is not that of the
    following row (the last of every episode), and `jump_obs` (K, O), their next observations.
    """
    obs, following = arrays["obs"], arrays["next_obs"]
    kept = {name: array for name, array in arrays.items() if name != "next_obs"}
    chained = np.append((obs[1:] == following[:-1]).all(1), False)
    jump = np.flatnonzero(~chained[: len(obs)]).astype(np.int32)
    return kept | {"jump": jump, "jump_obs": following[jump]}


def _following(arrays: Arrays) -> NDArray:
    """`next_obs` (N, O), restored from the result of `without_next_obs`."""
    obs, jump = arrays["obs"], arrays["jump"]
    inside = jump.dtype.kind == "i" and ((jump >= 0) & (jump < len(obs))).all()
    if not inside:
        raise ValueError("a row that it names is not there")
    following = np.concatenate([obs[1:], obs[-1:]])
    following[jump] = arrays["jump_obs"]
    return following


def _single(array: NDArray) -> NDArray:
    return array.astype(np.float32) if array.dtype == np.float16 else array


def empty_transitions() -> tuple[Transitions, NDArray[np.int64]]:
    """No rows."""
    flat, wide = np.zeros(0, np.float32), np.zeros((0, 0), np.float32)
    rows = Transitions(wide, wide, flat, wide, flat.astype(bool), flat.astype(bool))
    return rows, np.zeros(0, np.int64)


def profiles_of(rows: Sequence[Mapping[str, Any]]) -> tuple[Profiles, int]:
    """The profiles in the rows of `weights/profiles.jsonl`, and how many rows were unusable.

    The number of bins is that of the first usable row.
    """
    read = [row for row in map(_profile_row, rows) if row is not None]
    width = len(read[0][1]) if read else 0
    good = [row for row in read if len(row[1]) == width]
    columns = list(zip(*good, strict=True)) if good else [(), (), (), (), ()]
    profiles = Profiles(
        env_step=np.array(columns[0], np.int64),
        bins=np.array(columns[1], np.float64).reshape(len(good), width),
        count=np.array(columns[2], np.int64),
        ess=np.array(columns[3], np.float64),
        zeros=np.array(columns[4], np.float64),
    )
    return profiles, len(rows) - len(good)


def _profile_row(row: Mapping[str, Any]) -> tuple[int, NDArray, int, float, float] | None:
    try:
        bins = np.array(row["bins"], np.float64)  # null becomes NaN
        if bins.ndim != 1:
            return None
        if not (is_whole(row["env_step"]) and is_whole(row["count"])):
            return None
        ess, zeros = _number(row["ess"]), _number(row["zeros"])
        return row["env_step"], bins, row["count"], ess, zeros
    except (KeyError, TypeError, ValueError, OverflowError):
        return None


def _number(value: Any) -> float:
    return np.nan if value is None else float(value)


def is_whole(value: Any) -> TypeGuard[int]:
    """Whether it is an integer that an array can hold."""
    return isinstance(value, int) and not isinstance(value, bool) and abs(value) < HUGE


def numbers(row: Mapping[str, Any]) -> dict[str, float]:
    """The finite numbers among the values of a metric row, by name, without its `env_step`."""
    return {
        name: float(value)
        for name, value in row.items()
        if name != "env_step" and isinstance(value, int | float) and abs(value) < LARGEST
    }


def metrics_table(rows: Sequence[Mapping[str, Any]]) -> pd.DataFrame:
    """The table of metric rows: `env_step` as int64, every metric as float64, null as NaN.

    Rows of the same step are merged; for a metric in several of them the last one counts.
    """
    merged: dict[int, dict[str, float]] = {}
    names: dict[str, None] = {}
    for row in rows:
        if is_whole(step := row.get("env_step")):
            merged.setdefault(step, {}).update(numbers(row))
            names |= dict.fromkeys(row)
    names.pop("env_step", None)
    values = [[merged[step].get(name, np.nan) for name in names] for step in sorted(merged)]
    table = pd.DataFrame(
        np.array(values, np.float64).reshape(len(merged), len(names)), columns=[*names]
    )
    table.insert(0, "env_step", np.array(sorted(merged), np.int64))
    return table
