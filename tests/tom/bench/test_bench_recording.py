"""What the measurements of recording count."""

from pathlib import Path

import pytest

from tom.bench.recording import checkpoint_costs, make_store, recording_costs
from tom.record import Store, checkpoint


def test_shares_are_of_the_training_and_parts_add_up():
    rows = {row["part"]: row for row in recording_costs(train_s=10.0)}
    for row in rows.values():
        assert row["share_percent"] == pytest.approx(row["ms"] / 10.0 / 10)
    names = list(rows)
    parts = sum(rows[name]["ms"] for name in names[: names.index("all files")])
    assert rows["all files"]["ms"] == pytest.approx(parts)
    assert rows["all files and Rerun"]["ms"] == pytest.approx(parts + rows["Rerun"]["ms"])


def test_a_checkpoint_is_measured_with_full_buffers():
    hopper, humanoid = checkpoint_costs(train_s=10.0)
    rows = 4 * 100_000 * (2 * 11 + 3 + 3) * 4 / 1e6  # the model buffer: four fits' rollouts
    assert rows < hopper["megabytes"] < 1.5 * rows < humanoid["megabytes"]
    assert hopper["megabytes_at_most"] == (checkpoint.KEPT + 1) * hopper["megabytes"]
    expected = 100 * hopper["ms"] / 1e3 / (10.0 * 2000 / 250)
    assert hopper["share_percent"] == pytest.approx(expected)
    assert humanoid["share_percent"] is None


def test_the_store_that_is_listed_is_one_of_real_runs(tmp_path: Path):
    runs = Store(make_store(tmp_path, runs=3)).runs()
    assert sorted(run.run_id for run in runs) == ["run-0000", "run-0001", "run-0002"]
    assert {run.status.state for run in runs} == {"finished"}
    assert all(len(run.metrics()) for run in runs)
