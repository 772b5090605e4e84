"""What the benchmark counts; it times nothing here."""

from dataclasses import replace

import pytest

from tom.bench.parts import model_flops, network_flops, parts, rollout_flops, sac_flops
from tom.bench.projection import hours, per_step_ms
from tom.bench.targets import target
from tom.bench.timing import Timing
from tom.config import ModelConfig, OnlineConfig, SacConfig
from tom.envs import ENV_NAMES, task
from tom.training.presets import resolve

MS = {part.name: 1.0 for part in parts()}


def timing(part: str, ms: float = 1.0, floor: float | None = None, ours: float | None = None):
    return Timing(part, ms, ms, ms, None, floor, ours)


def test_the_arithmetic_of_an_update_is_what_is_published():
    assert sac_flops(SacConfig()) == pytest.approx(561e6, rel=0.01)
    assert network_flops([2, 3, 1], 10) == 2 * 10 * (6 + 3)
    assert model_flops(ModelConfig(kind="ensemble")) > 4 * model_flops(ModelConfig())
    assert rollout_flops(ModelConfig(), SacConfig()) < model_flops(ModelConfig()) / 256


def test_targets_are_met_on_their_own_side():
    assert target(timing("SAC update", floor=1.6)) == ("<= 1.7 x floor", True)
    assert target(timing("mbrl-lib SAC update", ours=2.4)) == (">= 2.5 x ours", False)
    assert target(timing("rollout, 1000 states", ms=3.5)) == ("<= 3.0 ms", False)
    assert target(timing("Hopper-v5 step")) is None


def test_a_target_that_no_code_could_meet_on_this_machine_says_so():
    row = replace(timing("rollout, 1000 states", ms=8.4), floor_ms=5.21)
    assert target(row) == ("<= 3.0 ms, under this machine's floor of 5.2", False)
    assert target(replace(row, floor_ms=2.9)) == ("<= 3.0 ms", False)


def test_every_environment_and_preset_is_projected():
    rows = {row["env"]: row for row in hours(MS)}
    assert set(rows) == set(ENV_NAMES) - {"road-and-rocks"}
    assert rows["humanoid"]["paper_h"] > rows["walker2d"]["paper_h"]  # wider networks
    assert rows["hopper"]["mbpo_h"] > rows["hopper"]["paper_h"]  # more updates a step


def test_a_step_of_hopper_is_the_sum_of_its_parts():
    config = resolve("hopper", "tom", "paper")
    assert isinstance(config, OnlineConfig)
    fit = 30 * 100 + 1000 + 100 + 125_000 / 2 / 1000 + 100
    expected = 5 + fit / 250 + 1
    assert per_step_ms(config, task("hopper"), MS) == pytest.approx(expected)
