from pathlib import Path

from tom.bench.listing import make_store
from tom.record import Store


def test_the_store_that_is_listed_is_one_of_real_runs(tmp_path: Path):
    runs = Store(make_store(tmp_path, runs=3)).runs()
    assert sorted(run.run_id for run in runs) == ["run-0000", "run-0001", "run-0002"]
    assert {run.status.state for run in runs} == {"finished"}
    assert all(len(run.metrics()) for run in runs)
