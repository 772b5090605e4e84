"""Data of other programs in their true layouts, made here: read, or refused in one line."""

import json
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path

import h5py
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.dataset
import pyarrow.parquet as pq
import pytest
from common import Evil, one_line

from tom.data.datasets import initial_obs
from tom.data.datasets import read_dataset as read_recording
from tom.data.transitions import Transitions

Columns = dict[str, np.ndarray]

# Three episodes of 4, 3 and 3 rows: a terminal state, a time limit, a recording that just stops.
LENGTHS, N = (4, 3, 3), 10
TERMINATED = np.arange(N) == 3
TRUNCATED = np.isin(np.arange(N), (6, 9))
STARTS = [0, 4, 7]
D4RL = ("observations", "actions", "rewards", "next_observations", "terminals", "timeouts")


def read_dataset(path: Path) -> Transitions:
    return read_recording(path).rows


@pytest.fixture
def columns() -> Columns:
    """Row t of episode e has obs (100 e + t, -t)."""
    states = [np.array([[100.0 * e + t, -t] for t in range(n + 1)]) for e, n in enumerate(LENGTHS)]
    obs, next_obs = (np.concatenate([s[part] for s in states]) for part in (np.s_[:-1], np.s_[1:]))
    draw = np.random.default_rng(0).normal
    return {
        "obs": obs.astype(np.float32), "action": draw(size=(N, 3)).astype(np.float32),
        "reward": draw(size=N).astype(np.float32), "next_obs": next_obs.astype(np.float32),
        "terminated": TERMINATED, "truncated": TRUNCATED,
    }  # fmt: skip


def as_d4rl(columns: Columns) -> Columns:
    names = dict(zip(columns, D4RL, strict=True))
    return {names[name]: values for name, values in columns.items()}


def npz(path: Path, columns: Columns) -> Path:
    np.savez(path, allow_pickle=True, **columns)
    return path


def parquet(path: Path, columns: Columns) -> Path:
    frame = {n: list(values) if values.ndim == 2 else values for n, values in columns.items()}
    pd.DataFrame(frame).to_parquet(path)
    return path


def hdf5(path: Path, columns: Columns) -> Path:
    with h5py.File(path, "w") as file:
        for name, values in (columns | {"infos/qpos": np.zeros((N, 4))}).items():
            file.create_dataset(name, data=values, compression="gzip")
        file["metadata/algorithm"] = b"SAC"
    return path


WRITERS = {".npz": npz, ".parquet": parquet, ".hdf5": hdf5}
each_format = pytest.mark.parametrize("suffix", WRITERS)


def same(found: Transitions, columns: Columns) -> None:
    for field in fields(found):
        np.testing.assert_array_equal(getattr(found, field.name), columns[field.name])


def refused(path: Path, words: str | None = None) -> None:
    with one_line(words):
        read_dataset(path)


@each_format
@pytest.mark.parametrize("named", [dict, as_d4rl])
def test_columns_are_read_as_they_are_under_both_names(
    tmp_path: Path, columns: Columns, suffix: str, named: Callable
):
    found = read_dataset(WRITERS[suffix](tmp_path / f"a{suffix}", named(columns)))
    same(found, columns)
    np.testing.assert_array_equal(initial_obs(found), columns["obs"][STARTS])


def test_other_types_and_trailing_axes_are_the_same_numbers(tmp_path: Path, columns: Columns):
    other = {name: values.astype(np.float64) for name, values in columns.items()}
    other |= {"reward": other["reward"][:, None], "truncated": columns["truncated"][:, None] * 1}
    other["truncated"] |= TERMINATED[:, None]  # a terminal state at the time limit is terminal
    same(read_dataset(npz(tmp_path / "a.npz", other)), columns)


def test_parquet_may_number_the_columns_of_a_vector(tmp_path: Path, columns: Columns):
    flat = {n: values for n, values in columns.items() if values.ndim == 1}
    for name in ("next_obs", "obs", "action"):
        for i in reversed(range(columns[name].shape[1])):
            flat[f"{name}_{i}"] = columns[name][:, i]
    pq.write_table(pa.table(flat), tmp_path / "flat.parquet")
    same(read_dataset(tmp_path / "flat.parquet"), columns)
    del flat["obs_0"]
    pq.write_table(pa.table(flat), tmp_path / "gap.parquet")
    refused(tmp_path / "gap.parquet", "obs_")


def test_without_truncated_an_episode_ends_where_the_next_row_does_not_follow(
    tmp_path: Path, columns: Columns
):
    given = {name: values for name, values in columns.items() if name != "truncated"}
    same(read_dataset(npz(tmp_path / "a.npz", given)), columns)


def test_without_next_obs_no_transition_crosses_episodes(tmp_path: Path, columns: Columns):
    given = {name: values for name, values in columns.items() if name != "next_obs"}
    found = read_dataset(npz(tmp_path / "a.npz", given))
    kept = [0, 1, 2, 4, 5, 7, 8]  # the last row of each episode has no next observation
    for name in ("obs", "action", "reward", "next_obs"):
        np.testing.assert_array_equal(getattr(found, name), columns[name][kept])
    assert not np.any(found.terminated)
    assert np.flatnonzero(found.truncated).tolist() == [2, 4, 6]
    np.testing.assert_array_equal(initial_obs(found), columns["obs"][STARTS])


def with_nan(values: np.ndarray) -> np.ndarray:
    wrong = values.astype(np.float64)
    wrong[[2, 5]] = np.nan
    return wrong


@pytest.mark.parametrize(
    ("name", "change", "words"),
    [
        ("obs", None, "lacks obs"),
        ("reward", lambda r: r[:-1], "reward 9"),
        ("obs", with_nan, "'obs' .* 2 rows, first in row 2"),
        ("terminated", with_nan, "'terminated' .* 2 rows, first in row 2"),
        ("reward", lambda r: r.astype(np.float64) * 1e300, "'reward' is not finite"),
        ("next_obs", lambda o: o[:, :1], "'next_obs' has 1 dimensions, 'obs' has 2"),
    ],
)
def test_what_is_wrong_is_one_line(tmp_path: Path, columns, name, change, words):
    wrong = {**columns, name: change and change(columns[name])}
    given = {n: values for n, values in wrong.items() if values is not None}
    refused(npz(tmp_path / "a.npz", given), words)


def test_columns_that_do_not_make_episodes_are_one_line(tmp_path: Path, columns: Columns):
    without = {n: values for n, values in columns.items() if n not in ("next_obs", "truncated")}
    refused(npz(tmp_path / "neither.npz", without), "next_obs or truncated")
    refused(npz(tmp_path / "twice.npz", columns | {"observations": columns["obs"]}), "twice")
    refused(
        npz(tmp_path / "empty.npz", {n: values[:0] for n, values in columns.items()}), "no rows"
    )


@each_format
def test_damaged_and_foreign_files_are_one_line(tmp_path: Path, columns: Columns, suffix: str):
    whole = WRITERS[suffix](tmp_path / f"whole{suffix}", columns).read_bytes()
    (tmp_path / f"cut{suffix}").write_bytes(whole[: len(whole) // 2])
    (tmp_path / f"text{suffix}").write_text("hello")
    for name in ("cut", "text", "absent"):
        refused(tmp_path / f"{name}{suffix}")


def test_pickles_are_not_loaded(tmp_path: Path, columns: Columns):
    trap = np.array([Evil(tmp_path / "executed")] * N, object)
    refused(npz(tmp_path / "a.npz", columns | {"obs": trap}), "allow_pickle")
    for name in ("buffer.pkl", "model.zip", "buffer.pt", "rows.csv"):
        (tmp_path / name).write_bytes(b"anything")
        refused(tmp_path / name, r"\.npz")
    assert not (tmp_path / "executed").exists()


# Minari

FORMS = ("hdf5", "arrow", "parquet")
STEPS = (3, 1, 2, *([2] * 9))  # twelve episodes: 10 must come after 9, not after 1


def episodes() -> list[Columns]:
    """Episode 0 terminates, the last one is cut short without a flag, the others time out."""
    made = []
    for e, n in enumerate(STEPS):
        flags = np.zeros((2, n), bool)
        if e < len(STEPS) - 1:
            flags[min(e, 1), -1] = True
        made.append(
            {
                "observations": 100.0 * e + np.arange((n + 1) * 4.0).reshape(n + 1, 4),
                "actions": (e + np.arange(n * 2.0).reshape(n, 2)).astype(np.float32),
                "rewards": e + np.arange(n) / 8,
                "terminations": flags[0],
                "truncations": flags[1],
            }
        )
    return made


def write_hdf5(folder: Path) -> None:
    with h5py.File(folder / "main_data.hdf5", "w", track_order=True) as file:
        for e, episode in enumerate(episodes()):
            group = file.create_group(f"episode_{e}")
            for name, values in episode.items():
                group.create_dataset(name, data=values, chunks=True)
            group.create_group("infos").create_dataset("x", data=np.zeros(STEPS[e] + 1))


def write_arrow(folder: Path, form: str) -> None:
    for e, episode in enumerate(episodes()):
        columns: dict = {"episode_id": np.full(STEPS[e] + 1, e, np.int32)}
        for name, values in episode.items():
            pad = STEPS[e] + 1 - len(values)
            padded = np.pad(values, ((0, pad), *([(0, 0)] * (values.ndim - 1))))
            columns[name] = padded
            if values.ndim == 2:
                kind = pa.list_(pa.from_numpy_dtype(values.dtype), values.shape[1])
                columns[name] = pa.FixedSizeListArray.from_arrays(padded.reshape(-1), type=kind)
        pyarrow.dataset.write_dataset(
            pa.RecordBatch.from_pydict(columns),
            folder,
            format=form,
            partitioning=["episode_id"],
            existing_data_behavior="overwrite_or_ignore",
        )
        (folder / str(e) / "metadata.json").write_text(json.dumps({"id": e}))


@pytest.fixture
def minari(tmp_path: Path) -> Callable[[str], Path]:
    def dataset(form: str) -> Path:
        data = tmp_path / f"hopper/{form}-v0/data"
        data.mkdir(parents=True)
        write_hdf5(data) if form == "hdf5" else write_arrow(data, form)
        about = {"total_episodes": len(STEPS), "data_format": form, "minari_version": "0.5.4"}
        (data / "metadata.json").write_text(json.dumps(about))
        return data.parent

    return dataset


@pytest.mark.parametrize("form", FORMS)
def test_minaris_episodes_are_read_in_the_order_of_collection(minari, form: str):
    made, t = episodes(), read_dataset(minari(form))
    for name, expected in {
        "obs": [e["observations"][:-1] for e in made],
        "next_obs": [e["observations"][1:] for e in made],
        "action": [e["actions"] for e in made],
        "reward": [e["rewards"] for e in made],
        "terminated": [e["terminations"] for e in made],
    }.items():
        np.testing.assert_array_equal(getattr(t, name), np.concatenate(expected))
    ends = np.cumsum(STEPS) - 1
    assert np.flatnonzero(t.truncated).tolist() == ends[1:].tolist()
    np.testing.assert_array_equal(initial_obs(t), [e["observations"][0] for e in made])


def test_the_inner_folder_and_folders_of_older_versions(minari):
    root = minari("hdf5")
    expected = read_dataset(root)
    np.testing.assert_array_equal(read_dataset(root / "data").obs, expected.obs)
    (root / "data" / "metadata.json").unlink()
    np.testing.assert_array_equal(read_dataset(root).obs, expected.obs)


def test_folders_that_are_none_of_minaris_are_one_line(minari, tmp_path: Path):
    refused(tmp_path, "not a Minari dataset")
    root = minari("hdf5")
    with h5py.File(root / "data/main_data.hdf5", "a") as file:
        del file["episode_0/observations"]
        file["episode_0/observations/goal"] = np.zeros((4, 2))
    refused(root, "flat observations")
    (root / "data/metadata.json").write_text('{"data_format": "zarr"}')
    refused(root)
