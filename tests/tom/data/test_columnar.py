"""Transitions in `.npz` and Parquet files: as they are, or one line that says what is wrong."""

import os
from dataclasses import fields
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from tom.data.columnar import read_columnar
from tom.data.datasets import read_dataset
from tom.data.transitions import Transitions
from tom.errors import UserError

N = 7
ENDS = np.array([0, 0, 1, 0, 0, 0, 0], bool)
CUT = np.array([0, 0, 0, 0, 1, 0, 1], bool)


@pytest.fixture
def columns() -> dict[str, np.ndarray]:
    draw = np.random.default_rng(0).normal
    obs = draw(size=(N, 3)).astype(np.float32)
    following = np.roll(obs, -1, 0)
    following[ENDS | CUT] = draw(size=(3, 3))
    return {
        "obs": obs, "action": draw(size=(N, 2)).astype(np.float32),
        "reward": draw(size=N).astype(np.float32), "next_obs": following,
        "terminated": ENDS, "truncated": CUT,
    }  # fmt: skip


def npz(path: Path, columns: dict) -> Path:
    np.savez(path, **columns)
    return path


def same(found: Transitions, columns: dict[str, np.ndarray]) -> None:
    for field in fields(found):
        np.testing.assert_array_equal(getattr(found, field.name), columns[field.name])


def test_an_npz_file_is_read_as_it_is(tmp_path: Path, columns):
    same(read_dataset(npz(tmp_path / "a.npz", columns)), columns)
    same(read_dataset(npz(tmp_path / "more.npz", columns | {"note": np.array("mine")})), columns)
    wide = {name: values.astype(np.float64) for name, values in columns.items()}
    wide["reward"] = wide["reward"][:, None]
    same(read_dataset(npz(tmp_path / "wide.npz", wide)), columns)


def test_d4rls_names_are_known(tmp_path: Path, columns):
    names = ("observations", "actions", "rewards", "next_observations", "terminals", "timeouts")
    theirs = dict(zip(names, columns.values(), strict=True))
    same(read_dataset(npz(tmp_path / "a.npz", theirs)), columns)
    with pytest.raises(UserError, match="has 'obs' twice"):
        read_dataset(npz(tmp_path / "b.npz", theirs | {"obs": columns["obs"]}))


def test_parquet_with_lists_or_numbered_columns(tmp_path: Path, columns):
    frame = {n: list(values) if values.ndim == 2 else values for n, values in columns.items()}
    pd.DataFrame(frame).to_parquet(tmp_path / "lists.parquet")
    same(read_dataset(tmp_path / "lists.parquet"), columns)
    flat = {n: values for n, values in columns.items() if values.ndim == 1}
    flat |= {f"{n}_{i}": columns[n][:, i] for n in ("action", "next_obs", "obs") for i in (1, 0)}
    flat |= {f"{n}_2": columns[n][:, 2] for n in ("obs", "next_obs")}
    pq.write_table(pa.table(flat), tmp_path / "flat.parquet")
    same(read_dataset(tmp_path / "flat.parquet"), columns)
    del flat["obs_1"]
    pq.write_table(pa.table(flat), tmp_path / "gap.parquet")
    with pytest.raises(UserError, match="are not numbered from 0 without a gap"):
        read_dataset(tmp_path / "gap.parquet")


def test_without_truncated_episodes_end_where_the_next_row_does_not_follow(tmp_path, columns):
    del columns["truncated"]
    found = read_dataset(npz(tmp_path / "a.npz", columns))
    np.testing.assert_array_equal(found.truncated, CUT)


def test_without_next_obs_the_next_row_follows(tmp_path: Path, columns):
    del columns["next_obs"]
    found = read_dataset(npz(tmp_path / "a.npz", columns))
    kept = [0, 1, 3, 5]
    np.testing.assert_array_equal(found.obs, columns["obs"][kept])
    np.testing.assert_array_equal(found.next_obs, columns["obs"][[1, 2, 4, 6]])
    np.testing.assert_array_equal(found.truncated, [False, True, True, True])


def nan(values: np.ndarray) -> np.ndarray:
    values = values.copy()
    values[[2, 5]] = np.nan
    return values


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("obs", None, "lacks obs .it has action, reward, next_obs"),
        ("reward", lambda r: r[:-1], "differ in their number of rows .obs 7, action 7, reward 6"),
        ("obs", nan, "'obs' is not finite in 2 rows, first in row 2"),
        ("reward", lambda r: r.astype(np.float64) * 1e300, "'reward' is not finite"),
        ("obs", lambda o: o[:, 0], r"'obs' is float32 of shape 7, not numbers of shape \(N, O\)"),
        ("obs", lambda o: np.zeros((N, 2, 8, 8)), "float64 of shape 7x2x8x8, not numbers"),
        ("next_obs", lambda o: o[:, :2], "'next_obs' has 2 dimensions, 'obs' has 3"),
        ("action", lambda a: a.astype(str), "not numbers of shape"),
        ("obs", lambda o: np.array([{"a": 1}] * N, object), "allow_pickle"),
    ],
)
def test_what_is_wrong_is_one_line(tmp_path: Path, columns, name, change, message):
    wrong = {**columns, name: change and change(columns[name])}
    path = npz(tmp_path / "a.npz", {n: values for n, values in wrong.items() if values is not None})
    with pytest.raises(UserError, match=message) as raised:
        read_columnar(path)
    assert "\n" not in str(raised.value)


def test_both_of_next_obs_and_truncated_cannot_be_missing(tmp_path: Path, columns):
    del columns["next_obs"], columns["truncated"]
    with pytest.raises(UserError, match="lacks next_obs or truncated"):
        read_columnar(npz(tmp_path / "a.npz", columns))


def test_no_rows(tmp_path: Path, columns):
    empty = {name: values[:0] for name, values in columns.items()}
    with pytest.raises(UserError, match="holds no rows"):
        read_columnar(npz(tmp_path / "a.npz", empty))


@pytest.mark.parametrize("suffix", [".npz", ".parquet"])
def test_damaged_files_are_one_line(tmp_path: Path, columns, suffix):
    path = tmp_path / f"cut{suffix}"
    path.write_bytes(npz(tmp_path / "a.npz", columns).read_bytes()[:300])
    with pytest.raises(UserError, match="cannot be read as"):
        read_columnar(path)


def test_lists_of_different_lengths_and_missing_values(tmp_path: Path):
    for name, column in {"lists": [[1.0], [1.0, 2.0]], "gaps": [1.0, None]}.items():
        pq.write_table(pa.table({"obs": column}), tmp_path / f"{name}.parquet")
    with pytest.raises(UserError, match="lists of column 'obs' differ in length"):
        read_columnar(tmp_path / "lists.parquet")
    with pytest.raises(UserError, match="column 'obs' has 1 rows without a value"):
        read_columnar(tmp_path / "gaps.parquet")


class Trap:
    def __reduce__(self):
        return os.mkdir, ("trapped",)


def test_pickles_are_not_loaded(tmp_path: Path, columns, monkeypatch):
    monkeypatch.chdir(tmp_path)
    trap = np.array([Trap()] * N, object)
    with pytest.raises(UserError, match="allow_pickle"):
        read_columnar(npz(tmp_path / "a.npz", columns | {"obs": trap}))
    for name in ("buffer.pkl", "model.zip", "buffer.pt"):
        (tmp_path / name).write_bytes(b"anything")
        with pytest.raises(UserError, match="are not loaded: export the transitions to"):
            read_dataset(tmp_path / name)
    assert not (tmp_path / "trapped").exists()


def test_another_kind_of_file_is_named_so(tmp_path: Path):
    (tmp_path / "rows.csv").write_text("obs,action")
    with pytest.raises(UserError, match=r"rows.csv is of no kind that can be read here: give an "):
        read_dataset(tmp_path / "rows.csv")


def test_episodes_of_one_row_without_successors_are_one_line(tmp_path: Path, columns):
    columns["terminated"] = np.ones(N, bool)
    del columns["next_obs"]
    with pytest.raises(UserError, match="has no 'next_obs', and every row of it is the last"):
        read_dataset(npz(tmp_path / "a.npz", columns))
