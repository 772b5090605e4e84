import numpy as np
import pandas as pd
import pytest

from tom.analysis import planes
from tom.data.transitions import Transitions

NAMES = ("a", "b"), ("c",)


def rows_of(table: np.ndarray) -> Transitions:
    """Rows with these features (s, a, s')."""
    none = np.zeros(len(table))
    return Transitions(table[:, :2], table[:, 2:3], none, table[:, 3:], none, none)


@pytest.fixture
def table() -> np.ndarray:
    rng = np.random.default_rng(1)
    mixed = rng.normal(size=(4000, 5)) @ rng.normal(size=(5, 5))
    return ((mixed - mixed.mean(0)) / mixed.std(0)).astype(np.float32)


@pytest.fixture
def weight(table: np.ndarray) -> np.ndarray:
    return 2.0 ** (2 * table[:, 0] - np.abs(table[:, 1])) * (table[:, 2] < 1.5)


def test_contrast_spans_the_first_two_krylov_directions(table: np.ndarray, weight: np.ndarray):
    """Partial least squares with one response spans X'y, (X'X) X'y (Helland 1988)."""
    plane = planes.contrast_of(rows_of(table), weight, NAMES)
    x = table.astype(np.float64) - table.astype(np.float64).mean(0)
    log = np.log2(np.maximum(weight / weight.mean(), 1 / 32))
    first = x.T @ (log - log.mean())
    basis, _ = np.linalg.qr(np.stack([first, x.T @ x @ first], 1))
    assert plane.axes.T @ plane.axes == pytest.approx(np.eye(2), abs=1e-9)
    assert basis @ basis.T @ plane.axes == pytest.approx(plane.axes, abs=1e-6)
    assert np.corrcoef(plane.project(table)[:, 0], log)[0, 1] > 0.5


def test_principal_components_are_those_of_a_singular_value_decomposition(table: np.ndarray):
    plane = planes.principal_of(rows_of(table), NAMES)
    vectors = np.linalg.svd(table.astype(np.float64) - table.mean(0), full_matrices=False)[2]
    assert np.abs(np.sum(vectors[:2].T * plane.axes, 0)) == pytest.approx([1, 1], abs=1e-6)


def test_the_share_explained_is_that_of_a_table_grouped_by_cell(
    table: np.ndarray, weight: np.ndarray
):
    xy = planes.contrast_of(rows_of(table), weight, NAMES).project(table)
    log = pd.Series(np.log2(np.maximum(weight / weight.mean(), 1 / 32)))
    side = int((len(weight) / 24) ** 0.5)
    ends = [np.quantile(axis.astype(float), [0.005, 0.995]).tolist() for axis in xy.T]
    edges = [np.linspace(low, high, side + 1) for low, high in ends]
    cells = [
        pd.Series(np.digitize(axis, edge[1:-1])) for axis, edge in zip(xy.T, edges, strict=True)
    ]
    fitted = pd.Series(np.random.default_rng(0).random(len(log)) < 0.5)
    rows = pd.DataFrame({"log": log, "x": cells[0], "y": cells[1]})
    mean = log[fitted].mean()
    of_cell = (
        rows[fitted].groupby(["x", "y"])[["log"]].agg(lambda of: (of.sum() + mean) / (len(of) + 1))
    )
    predicted = rows[~fitted].join(of_cell, on=["x", "y"], rsuffix=" mean")["log mean"].fillna(mean)
    error = ((rows["log"][~fitted] - predicted) ** 2).mean()
    share = 1 - error / ((rows["log"][~fitted] - mean) ** 2).mean()
    assert planes.explained_share(xy, weight) == pytest.approx(share, abs=1e-3)
    assert share > 0.3


@pytest.mark.parametrize("count", [0, 1, 50])
def test_equal_weights_and_constant_rows_have_a_plane_that_explains_nothing(count: int):
    flags = np.zeros(count)
    rows = Transitions(
        np.ones((count, 2)), np.ones((count, 1)), flags, np.ones((count, 2)), flags, flags
    )
    names = ("x", "v"), ("push",)
    assert planes.feature_names(*names) == ["x", "v", "push", "next x", "next v"]
    plane = planes.contrast_of(rows, np.ones(count), names)
    assert not plane.axes.any()
    xy = planes.of_rows(plane, rows)
    assert xy.shape == (count, 2)
    assert planes.explained_share(xy, np.ones(count)) == 0


def test_an_axis_is_named_by_its_largest_loadings():
    axes = np.array([[0.1, -0.8, 0.2, 0.0, -0.7], np.zeros(5)]).T
    assert planes.axis_names(axes, NAMES) == ("b down, c up", "no dimension varies")


def test_rows_count_the_whole_record_and_ages_the_rows_themselves():
    values = np.arange(12.0)
    ended = np.isin(values, [3, 9])
    obs = values[:, None]
    record = Transitions(obs, obs, values, obs + 1, ended, np.zeros(12, bool))
    table = planes.row_table(record, np.ones(4), 11, (["x"], ["push"]))
    assert table["row"].tolist() == [7, 8, 9, 10]
    assert table["episode"].tolist() == [1, 1, 1, 2]
    assert table["episode_step"].tolist() == [3, 4, 5, 0]
    assert table["age"].tolist() == [12.5, 37.5, 62.5, 87.5]
    assert table["reward"].tolist() == [7, 8, 9, 10]
