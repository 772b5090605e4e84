"""Return curves of small recorded runs whose every return is known."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from tom.events import Metrics, Tick
from tom.record import Recorder, RunWriter, Store
from tom.studies import returns as study
from tom.training.presets import resolve


def record(
    store: Store,
    env: str,
    learner: str,
    seed: int,
    returns: Sequence[float],
    preset: str = "paper",
    **changes: int,
) -> None:
    """A run with these returns at steps 1 000, 2 000 and so on."""
    config = resolve(env, learner, preset, {"seed": seed, **changes})
    run_id = store.new_run_id(env, learner, seed)
    with Recorder(RunWriter.create(store, run_id, config)) as recorder:
        for i, value in enumerate(returns, start=1):
            recorder.consume(Metrics(1000 * i, {"eval/return": value}))
            recorder.consume(Tick(1000 * i, "evaluate"))


@pytest.fixture
def store(tmp_path: Path) -> Store:
    made = Store(tmp_path)
    record(made, "hopper", "tom", 0, [10, 30, 20, 90])
    record(made, "hopper", "tom", 1, [20, 50, 40])
    record(made, "hopper", "mle", 0, [40, 10, 10])
    record(made, "walker2d", "tom", 0, [1, 2])
    record(made, "walker2d", "mle", 0, [3, 2])
    return made


def test_a_run_for_each_seed_of_the_largest_group_of_settings(store: Store):
    record(store, "hopper", "tom", 1, [0])  # shorter than the other of this seed
    record(store, "hopper", "tom", 2, [9, 9, 9, 9], updates_per_step=7)
    record(store, "hopper", "mle", 5, [1], preset="smoke")
    cells, left_out = study.select(store.runs(), "paper")
    assert [(c.env, c.learner, c.seeds) for c in cells] == [
        ("hopper", "mle", [0]),
        ("hopper", "tom", [0, 1]),
        ("walker2d", "mle", [0]),
        ("walker2d", "tom", [0]),
    ]
    assert len(left_out) == 2


def test_learners_are_compared_at_a_step_that_all_reach(store: Store):
    cells, _ = study.select(store.runs(), "paper")
    assert study.compared_at(cells) == {"hopper": 3000, "walker2d": 2000}
    rows = {(r["env"], r["learner"]): r for r in study.summary(cells, np.random.default_rng(0))}
    tom = rows["hopper", "TOM"]
    assert tom["mean"] == (30 + 50) / 2  # of the running maximum, not of what came after
    assert tom["n"] == 2
    assert "2 seeds are few" in tom["remark"]
    assert tom["steps to MLE's"] == np.median([4000, 2000])
    assert tom["area"] == pytest.approx(np.mean([(20 + 25) / 2, (35 + 45) / 2]))
    assert np.isnan(rows["hopper", "MLE"]["low"])


def test_wins_over_tasks_that_both_have(store: Store):
    cells, _ = study.select(store.runs(), "paper")
    (row,) = study.improvement(cells, np.random.default_rng(0))
    # Hopper: 30 and 50 against 40: half; Walker2d: 2 against 3: none.
    assert row["wins"] == pytest.approx((0.5 + 0) / 2)
    assert row["tasks"] == "hopper walker2d"


def test_what_is_said_is_what_was_found(store: Store):
    cells, _ = study.select(store.runs(), "paper")
    first, few, short = study.verdict(cells)
    assert "0 of 2 of the paper's environments; the paper says 4 of 5" in first
    assert "1 seed" in few
    assert "hopper 3000 of 125000" in short
    assert "nothing to compare" in study.verdict([c for c in cells if c.learner == "tom"])[0]


def test_learners_with_different_settings_are_not_ranked_without_a_remark(store: Store):
    record(store, "ant", "vagram-ensemble", 0, [1, 2])  # its preset has another model: no remark
    for learner in ("mle", "tom"):
        record(store, "ant", learner, 0, [1, 2])
        record(store, "halfcheetah", learner, 0, [1, 2], updates_per_step=7)  # both alike
    cells, _ = study.select(store.runs(), "paper")
    assert not [line for line in study.verdict(cells) if "differ" in line]
    record(store, "hopper", "mle", 0, [3, 3, 3, 3, 3], updates_per_step=7)
    record(store, "hopper", "mle", 1, [3, 3, 3, 3, 3], updates_per_step=7)
    cells, _ = study.select(store.runs(), "paper")
    (line,) = [line for line in study.verdict(cells) if "differ" in line]
    assert line.startswith("hopper: ")
    assert "(updates_per_step)" in line


def test_what_is_missing_is_named_with_its_command(store: Store):
    cells, _ = study.select(store.runs(), "paper")
    rows = study.missing(cells, ["hopper", "ant"], ["tom"])
    assert [(r["env"], r["longest"], r["of"]) for r in rows] == [
        ("hopper", 4000, 125_000),
        ("ant", 0, 300_000),
    ]
    assert rows[0]["command"] == "tom sweep --env hopper --learner tom --seeds 4"
