"""What a sweep is expected to take."""

import json
from pathlib import Path

import pytest
from common import measured

from tom.bench import projection
from tom.bench.projection import NEEDED, per_step_ms, written_bytes
from tom.cli import main
from tom.config import OnlineConfig
from tom.envs import ENVS
from tom.machine.matmul import cache_file
from tom.record import Store, checkpoint
from tom.record.writer import RunWriter
from tom.sweep.projection import cost, makespan
from tom.training.plan import checked, trials
from tom.training.presets import resolve

PLAN = {"env": "hopper", "learner": ["tom", "mle"], "steps": 45_000}
MS = dict.fromkeys(NEEDED, 1.0)


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


def test_the_last_run_ends_when_it_has_had_its_turn():
    assert makespan([3.0, 3.0], 8) == 3
    assert makespan([3.0, 1.0, 1.0, 2.0], 2) == 4
    assert makespan([], 2) == 0


def test_of_a_run_that_goes_on_what_is_left_is_counted(tmp_path: Path):
    (trial,) = trials(checked({**PLAN, "learner": "mle", "steps": 9_000}))
    store = Store(tmp_path / "store")
    told = [(step, {"model/loss": 0.0}) for step in (5_000, 9_000)]
    measured(store, trial.run_id, "mle", 0, *told, steps=9_000)
    whole, half, none = (cost(trial, store.runs(), done) for done in (0, 7_000, 9_000))
    assert whole is not None
    assert half is not None
    assert none is not None
    assert whole.hours > 0
    assert half.hours == pytest.approx(whole.hours / 2)  # the first 5 000 steps are exploration
    assert half.megabytes == pytest.approx(whole.megabytes * 2 / 9)
    assert (none.hours, none.megabytes) == (0, 0)


def test_a_measurement_is_kept_whole_or_not_at_all():
    assert projection.last_bench() is None
    projection.save_bench(MS)
    assert projection.last_bench() == MS
    cache_file("bench").write_text('{"SAC update": 1}')
    assert projection.last_bench() is None


def test_without_runs_a_robot_is_judged_by_the_bench(tmp_path: Path, capsys):
    words = ["--env", "hopper", "road-and-rocks", "--learner", "tom", "mle", "--steps", "45000"]
    sweep = ["sweep", *words, "--jobs", "2", "--store", str(tmp_path / "store"), "--dry-run"]
    assert main(sweep) == 0
    said = capsys.readouterr().out
    assert "`tom bench` last measured here" in said
    assert "about" not in said  # 0 h would be no answer
    projection.save_bench(MS)
    tom, mle = trials(checked(PLAN))
    newest = tmp_path / "store" / mle.run_id
    RunWriter.create(Store(tmp_path / "store"), mle.run_id, mle.config).close()
    checkpoint.save(newest / checkpoint.FOLDER, 25_000, {})
    assert main([*sweep, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    rows = {(row["env"], row["learner"]): row for row in found["runs"]}
    for trial, left, share in ((tom, 40_000, 1.0), (mle, 20_000, 4 / 9)):
        assert isinstance(trial.config, OnlineConfig)
        row = rows["hopper", trial.learner]
        hours = per_step_ms(trial.config, ENVS["hopper"], MS) * left / 3.6e6
        assert row["judged by"] == "tom bench, at most"
        assert row["hours"] == pytest.approx(hours)
        written = written_bytes(trial.config, ENVS["hopper"]) * share
        assert row["megabytes"] == pytest.approx(written / 1e6)
    assert rows["road-and-rocks", "tom"]["hours"] is None
    assert found["hours"] == pytest.approx(rows["hopper", "tom"]["hours"])  # beside the other


def test_bytes_are_those_of_a_run_that_was_made():
    """Hopper, 40 000 steps: 103 MB of checkpoints, 130 MB in all; its episodes ended early."""
    config = resolve("hopper", "mle", overrides={"steps": 40_000})
    assert isinstance(config, OnlineConfig)
    assert 130e6 < written_bytes(config, ENVS["hopper"]) < 200e6
