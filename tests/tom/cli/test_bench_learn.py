"""`tom bench learn`: what a run came to."""

import json
from pathlib import Path

from tom.cli.bench import learnt
from tom.record import RunReader


def run_with(path: Path, *rows: dict[str, float]) -> RunReader:
    (path / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    return RunReader(path)


def test_the_first_step_that_reached_the_return_counts(tmp_path: Path):
    run = run_with(
        tmp_path,
        {"env_step": 100, "eval/return": 900.0, "time/wall_s": 1.0},
        {"env_step": 150, "model/nll": 1.0, "time/wall_s": 2.0},
        {"env_step": 200, "eval/return": 950.0, "time/wall_s": 3.04},
        {"env_step": 300, "eval/return": 999.0},
    )
    row = learnt(run)
    assert (row["reached_at"], row["wall_s"]) == (200, 3.0)


def test_a_run_that_was_never_evaluated_has_reached_nothing(tmp_path: Path):
    assert learnt(run_with(tmp_path, {"env_step": 100}))["reached_at"] is None
    assert learnt(run_with(tmp_path))["reached_at"] is None
