"""What the benchmark counts; it times nothing here."""

from pathlib import Path

import pytest
from common import online, present

from tom.bench.parts import parts
from tom.bench.projection import beside_ms, between_fits_ms, hours, per_step_ms
from tom.bench.timing import (
    DISTANCES,
    EXAM,
    Timing,
    model_flops,
    network_flops,
    rollout_flops,
    sac_flops,
    target,
)
from tom.bench.training import checkpoint_cost, make_store
from tom.config import ModelConfig, SacConfig
from tom.envs import ENV_NAMES, task
from tom.record import Store, checkpoint

MS = {part.name: 1.0 for part in parts()}
BESIDE = {EXAM: 9950.0, DISTANCES: 990.0}  # ms


def timing(part: str, ms: float = 1.0, floor: float | None = None, ours: float | None = None):
    return Timing(part, ms, ms, ms, None, floor, ours)


def test_the_arithmetic_of_an_update_is_what_is_published():
    assert sac_flops(SacConfig()) == pytest.approx(561e6, rel=0.01)
    assert network_flops([2, 3, 1], 10) == 2 * 10 * (6 + 3)
    assert model_flops(ModelConfig(kind="ensemble")) > 4 * model_flops(ModelConfig())
    assert rollout_flops(ModelConfig(), SacConfig()) < model_flops(ModelConfig()) / 256


@pytest.mark.parametrize(
    ("row", "met"),
    [
        (timing("SAC update", floor=1.6), True),
        (timing("stable-baselines3 SAC update", ours=2.4), False),
        (timing("rollout, 1000 states", ms=3.5), False),
        (timing(EXAM, ms=50.0), True),
        (timing(EXAM, ms=150.0), False),
        (timing(DISTANCES, ms=9.0), True),
        (timing(DISTANCES, ms=11.0), False),
    ],
)
def test_targets_are_met_on_their_own_side(row: Timing, met: bool):
    wanted = present(target(row, BESIDE))
    assert wanted[1] is met
    assert target(timing("Hopper-v5 step"), BESIDE) is None


def test_the_time_between_two_fits_counts_the_shortest_fit():
    config = online("hopper", "tom", preset=None)  # as `tom train` has it
    rounds = 1 + config.model.patience + 1
    tom = config.tom.q_steps + config.tom.discriminator_steps
    fit = rounds * 100 + tom + 125_000 / 2 / 1000 + 100
    assert between_fits_ms(MS) == pytest.approx(250 * (5 + 1) + fit)
    assert between_fits_ms(MS | {EXAM: 9.0}) == between_fits_ms(MS)
    assert beside_ms(MS) == {EXAM: between_fits_ms(MS), DISTANCES: 1000 + 100 + 40}


def test_every_environment_and_preset_is_projected():
    rows = {row["env"]: row for row in hours(MS)}
    assert set(rows) == set(ENV_NAMES) - {"road-and-rocks"}
    assert rows["humanoid"]["paper_h"] > rows["walker2d"]["paper_h"]  # wider networks
    assert rows["hopper"]["mbpo_h"] > rows["hopper"]["paper_h"]  # more updates a step


def test_a_step_of_hopper_is_the_sum_of_its_parts():
    config = online("hopper", "tom", preset="paper")
    fit = 30 * 100 + 1000 + 100 + 125_000 / 2 / 1000 + 100
    expected = 5 + fit / 250 + 1
    assert per_step_ms(config, task("hopper"), MS) == pytest.approx(expected)


def test_a_checkpoint_is_measured_with_full_buffers():
    hopper = checkpoint_cost("hopper", train_s=10.0)
    rows = 4 * 100_000 * (2 * 11 + 3 + 3) * 4 / 1e6  # the model buffer: four fits' rollouts
    assert rows < hopper["megabytes"] < 1.5 * rows
    assert hopper["megabytes_at_most"] == (checkpoint.KEPT + 1) * hopper["megabytes"]
    expected = 100 * hopper["ms"] / 1e3 / (10.0 * 2000 / 250)
    assert hopper["share_percent"] == pytest.approx(expected)


def test_the_store_that_is_listed_is_one_of_real_runs(tmp_path: Path):
    runs = Store(make_store(tmp_path, runs=3)).runs()
    assert sorted(run.run_id for run in runs) == ["run-0000", "run-0001", "run-0002"]
    assert {run.status.state for run in runs} == {"finished"}
    assert all(len(run.metrics()) for run in runs)
