"""The tables that a reader sees."""

from types import SimpleNamespace

import numpy as np
import pytest

from app.data import tables
from tom.analysis.curves import Curve, groups


def curve(seed: int, value: list[float], learner: str = "tom") -> Curve:
    step = np.arange(len(value), dtype=np.int64) * 100
    return Curve(f"{learner}-{seed}", "ant", learner, "paper", seed, step, np.array(value))


def test_the_summary_counts_no_longer_run_beyond_the_shortest() -> None:
    row = tables.summary(groups([curve(0, [1, 2, 50]), curve(1, [3, 4])])).iloc[0]
    assert (row["steps"], row["final"], row["best"]) == (100, 3, 3)
    late = Curve("tom-2", "ant", "tom", "paper", 2, np.array([300]), np.array([9.0]))
    row = tables.summary(groups([curve(0, [1, 2]), late])).iloc[0]
    assert row["steps"] == 100
    assert np.isnan([row["final"], row["best"], row["final low"]]).all()


@pytest.mark.parametrize("points", [7, 400])
def test_final_is_where_the_line_of_all_runs_ends_whatever_their_steps(points: int) -> None:
    draw = np.random.default_rng(points)
    runs = []
    for seed in range(5):
        step = np.cumsum(draw.uniform(0.5, 1.5, points)) + draw.uniform(0, 2)
        value = draw.normal(size=points).cumsum()
        runs.append(Curve(f"tom-{seed}", "ant", "tom", "paper", seed, step, value))
    [group] = groups(runs)
    row = tables.summary([group]).iloc[0]
    end = np.flatnonzero(group.complete)[-1]
    assert row["steps"] == group.step[end]
    assert row["final"] == pytest.approx(group.mean[end])
    assert row["best"] >= row["final"]


def test_settings_have_a_column_for_each_run() -> None:
    one, other = SimpleNamespace(settings={"y": "2"}), SimpleNamespace(settings={"y": "3"})
    frame = tables.settings([one, other], ["one", "other"])  # pyright: ignore[reportArgumentType]
    assert list(frame.columns) == ["setting", "one", "other"]
    assert frame.loc[0].tolist() == ["y", "2", "3"]
    assert tables.settings([one], ["one"]).empty  # pyright: ignore[reportArgumentType]
