import numpy as np
import pytest
from common import online
from gymnasium.spaces import Box

from tom.config import RolloutConfig, TomConfig
from tom.envs import task
from tom.readable import in_words
from tom.training.plan import Plan, Trial, trials
from tom.training.presets import resolve


def test_the_papers_single_action_sample_is_a_preset_and_the_default_is_not():
    assert resolve("hopper", "tom", "paper").tom.action_samples == 1
    assert TomConfig.preset("paper").action_samples == 1
    assert resolve("hopper", "tom", "mbpo").tom.action_samples == TomConfig().action_samples == 4
    assert TomConfig.preset("exact").action_samples == 10


def test_a_plan_without_a_preset_has_each_learners_own_and_its_run_is_that_of_the_preset():
    plan = Plan(env=["hopper", "road-and-rocks"], learner=["mle", "tom"])
    assert [(trial.env, trial.learner, trial.preset) for trial in trials(plan)] == [
        ("hopper", "mle", "paper"),
        ("hopper", "tom", "mended"),
        ("road-and-rocks", "mle", "paper"),
        ("road-and-rocks", "tom", "paper"),
    ]
    named = Plan(env=["hopper"], learner=["tom"], preset="mended")
    assert trials(plan)[1].run_id == trials(named)[0].run_id


def test_rollout_length_follows_janners_schedule():
    """Hopper: 1 until epoch 20, 15 from epoch 150, linear between."""
    rollout = RolloutConfig(final_length=15, schedule_start=20, schedule_end=150)
    assert [rollout.length_at(1000 * e) for e in (0, 20, 85, 150, 300)] == [1, 1, 8, 15, 15]
    assert RolloutConfig().length_at(200_000) == 1


def test_a_rollout_length_alone_is_that_of_the_whole_training():
    assert [RolloutConfig(length=5).length_at(step) for step in (0, 500_000)] == [5, 5]
    assert RolloutConfig(length=5).kept_at(0, 250) == 5 * RolloutConfig().kept_at(0, 250)


@pytest.mark.parametrize("env", ["hopper", "walker2d", "halfcheetah", "ant", "humanoid"])
def test_the_papers_entropy_is_that_of_actions_in_the_tasks_own_range(env: str):
    """The released code: -dim A there; of actions in [-1, 1] the half range's logs are more."""
    config, known = online(env, "mle", preset=None), task(env)
    target = config.sac.target_entropy
    space = known.make().unwrapped.action_space
    assert isinstance(space, Box)
    expected = -known.action_dim - np.log(space.high).sum()
    assert (-known.action_dim if target is None else target) == pytest.approx(expected, abs=0.01)


def test_the_model_buffer_holds_what_janners_pool_holds():
    """rollout_batch_size * epoch_length / model_train_freq * rollout_length * retain_epochs."""
    hopper, humanoid = (online(env, "mle", preset="mbpo") for env in ("hopper", "humanoid"))
    assert hopper.rollout.kept_at(0, hopper.fit_every) == 400_000
    assert hopper.rollout.kept_at(150_000, hopper.fit_every) == 15 * 400_000
    assert humanoid.rollout.kept_at(0, humanoid.fit_every) == 5 * 100_000
    assert RolloutConfig(starts=10).kept_at(0, 5000) == 10  # one fit's at the least


def test_a_rule_that_is_not_given_is_not_recorded_and_changes_no_name_of_a_run():
    config = resolve("hopper", "tom")
    assert "termination" not in config.model_dump(mode="json")["model"]
    assert Trial("hopper", "tom", 0, "paper", {}).run_id == "hopper-tom-s0-eb0654a0"
    assert Trial("humanoid", "vagram-ensemble", 0, "paper", {}).run_id.endswith("-1eff8e87")
    given = resolve("hopper", "tom", "paper", {"model": {"termination": "never"}})
    recorded = given.model_dump(mode="json")
    assert recorded["model"]["termination"] == "never"
    assert type(given).model_validate(recorded) == given


def test_a_configuration_is_flat_words() -> None:
    config = {"seed": 1, "sac": {"lr": 3e-4, "target_entropy": None}, "x": True}
    assert in_words(config) == {
        "seed": "1",
        "sac.lr": "0.0003",
        "sac.target_entropy": "none",
        "x": "true",
    }
    assert in_words("damaged") == {}
