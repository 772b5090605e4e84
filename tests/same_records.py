"""Two run folders with the same record, to the last bit."""

import json

import numpy as np
import pandas as pd

from tom.record import RunReader


def untimed(run: RunReader) -> pd.DataFrame:
    """The metrics without those of the clock."""
    table = run.metrics()
    return table.drop(columns=[name for name in table if name.startswith("time/")])


def last_row(run: RunReader) -> dict[str, float]:
    """The last line of the metrics, without those of the clock."""
    line = (run.path / "metrics.jsonl").read_text().splitlines()[-1]
    return {k: v for k, v in json.loads(line).items() if not k.startswith("time/")}


def assert_same_record(first: RunReader, second: RunReader) -> None:
    """Metrics, weights, buffer and episodes are the same, and `second` has no problems."""
    pd.testing.assert_frame_equal(untimed(first), untimed(second), check_like=True)
    np.testing.assert_array_equal(first.profiles().bins, second.profiles().bins)
    assert first.snapshot_steps() == second.snapshot_steps()
    for step in first.snapshot_steps():
        pd.testing.assert_frame_equal(first.snapshot(step), second.snapshot(step))
    (a, versions_a), (b, versions_b) = first.buffer(), second.buffer()
    np.testing.assert_array_equal(a.obs, b.obs)
    np.testing.assert_array_equal(a.terminated, b.terminated)
    np.testing.assert_array_equal(versions_a, versions_b)
    assert first.evaluation_steps() == second.evaluation_steps()
    for step in first.evaluation_steps():
        for x, y in zip(first.episodes(step), second.episodes(step), strict=True):
            np.testing.assert_array_equal(x.obs, y.obs)
    assert second.problems == []
