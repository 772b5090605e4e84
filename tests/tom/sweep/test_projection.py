"""What a sweep is expected to take."""

from pathlib import Path

import pytest
from common import measured

from tom.record import Store
from tom.sweep.projection import cost, makespan
from tom.training.plan import checked, trials

PLAN = {"env": "hopper", "learner": ["tom", "mle"], "steps": 45_000}


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
