"""A recording of SAC: the halves, their order, the states and the policy that comes with it."""

from pathlib import Path

import numpy as np
import pytest
import torch
from common import one_line, present, stopping_at
from same_records import assert_same_record

from tom.config import SacRecordingConfig
from tom.errors import UserError
from tom.events import Evaluation, TrainedPolicy
from tom.policy.stored import UniformPolicy, policy_arrays, read_policy
from tom.record import RunReader, Store
from tom.record.thin import half
from tom.studies.progression import find_recording
from tom.training.resume import find_unfinished, resume
from tom.training.run import train
from tom.training.sac_recording import SacRecording

STEPS, EXPLORATION = 1100, 900


def config(env: str = "hopper", **changes: object) -> SacRecordingConfig:
    small = {
        "steps": STEPS,
        "exploration_steps": EXPLORATION,
        "sac": {"hidden": 16, "batch_size": 32},
        "evaluation": {"every": 1000, "episodes": 1},
    }
    return SacRecordingConfig(env=env).but(**{**small, **changes})


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> RunReader:
    store = Store(tmp_path_factory.mktemp("store"))
    return train(config(), store, "recorded", rerun=False)


def test_a_random_half_then_as_many_steps_of_sac(recording: RunReader):
    rows, version = recording.buffer()
    assert len(rows) == 2 * STEPS
    assert recording.status.env_step == recording.status.total == 2 * STEPS
    assert np.all(version[: STEPS + EXPLORATION] == 0)
    # One update after each step from the last random one on, so every row its own policy.
    learnt = version[STEPS + EXPLORATION :]
    np.testing.assert_array_equal(learnt, np.arange(1, STEPS - EXPLORATION + 1))
    assert not recording.problems


def test_rows_of_an_episode_join_and_the_halves_do_not(recording: RunReader):
    rows = recording.buffer()[0].numpy()
    ended = np.asarray(rows.terminated) | np.asarray(rows.truncated)
    joined = np.flatnonzero(~ended[:-1])
    np.testing.assert_array_equal(rows.next_obs[joined], rows.obs[joined + 1])
    assert ended[STEPS - 1]
    assert ended[-1]
    assert not np.any(np.asarray(rows.terminated) & np.asarray(rows.truncated))


def test_the_state_of_a_row_gives_its_obs(recording: RunReader):
    rows, _, state, _ = recording.recorded()
    # Hopper's obs: qpos without x, then qvel within +-10.
    expected = np.hstack([state["qpos"][:, 1:], state["qvel"].clip(-10, 10)])
    np.testing.assert_array_equal(rows.obs, expected)
    assert np.ptp(state["qpos"][:, 0]) > 0


def test_a_recording_is_found_again_by_its_settings(recording: RunReader):
    store = Store(recording.path.parent)
    found = present(find_recording(store, config(threads=2)))
    assert found.run_id == recording.run_id
    for other in ({"seed": 1}, {"steps": 1000}, {"sac": {"hidden": 32}}):
        changed = config().but(**other)
        assert find_recording(store, changed) is None


def test_same_seed_same_bits_and_evaluations_leave_no_trace():
    def rows(**changes: object) -> tuple[torch.Tensor, torch.Tensor]:
        small = config("inverted-pendulum", steps=120, exploration_steps=40, **changes)
        recording = SacRecording(small)
        events = list(recording.events())
        assert isinstance(events[-1], TrainedPolicy)
        assert isinstance(events[-4], Evaluation)
        return recording.replay.transitions().obs, recording.sac.actor.weights[0]

    seldom = rows()
    often = rows(evaluation={"every": 10, "episodes": 2})
    for a, b in zip(seldom, often, strict=True):
        assert torch.equal(a, b)
    assert not torch.equal(seldom[0], rows(seed=1)[0])


def test_a_stored_policy_is_the_policy_to_the_last_bit(tmp_path: Path):
    recording = SacRecording(config("inverted-pendulum", steps=80, exploration_steps=40))
    list(recording.events())
    arrays = policy_arrays("inverted-pendulum", recording.sac)
    np.savez(tmp_path / "policy.npz", allow_pickle=False, **arrays)
    stored = read_policy(tmp_path / "policy.npz")
    assert (stored.env, stored.obs_dim, stored.action_dim) == ("inverted-pendulum", 4, 1)
    obs = torch.randn(50, 4, generator=torch.Generator().manual_seed(3))
    assert torch.equal(stored.mean(obs), recording.policy.mean(obs))
    ours, theirs = (torch.Generator().manual_seed(4) for _ in range(2))
    sampled = stored(obs, 3, ours)
    assert sampled.shape == (3, 50, 1)
    assert torch.equal(sampled, recording.policy(obs, 3, theirs))
    assert stored.value_gradient is not None
    assert torch.equal(stored.value_gradient(obs), recording.policy.value_gradient(obs))
    of_old = {name: array for name, array in arrays.items() if not name.startswith("critic")}
    np.savez(tmp_path / "old.npz", allow_pickle=False, **of_old)
    assert read_policy(tmp_path / "old.npz").value_gradient is None
    halves = {name: half(array) for name, array in arrays.items()}  # as small copies keep them
    np.savez(tmp_path / "half.npz", allow_pickle=False, **halves)
    mean = read_policy(tmp_path / "half.npz").mean(obs)
    assert mean.dtype == torch.float32
    torch.testing.assert_close(mean, recording.policy.mean(obs), rtol=2e-3, atol=2e-3)


@pytest.mark.parametrize(
    "arrays",
    [
        {"env": np.array({"evil": 1}, object)},
        {
            "env": np.array("hopper"),
            "weight_0": np.zeros((3, 2), np.float32),
            "bias_0": np.zeros(2, np.float32),
            "critic_weight_0": np.zeros((2, 3, 1), np.float32),  # it should read 3 + 1 numbers
            "critic_bias_0": np.zeros((2, 1), np.float32),
        },
    ],
)
def test_what_is_no_policy_is_one_line(tmp_path: Path, arrays: dict[str, np.ndarray]):
    np.savez(tmp_path / "policy.npz", **arrays)  # pyright: ignore[reportArgumentType]
    with one_line("is not a stored policy"):
        read_policy(tmp_path / "policy.npz")


def test_the_random_policy_is_uniform():
    generator = torch.Generator().manual_seed(0)
    actions = UniformPolicy(4, 2)(torch.zeros(500, 4), 10, generator)
    assert actions.shape == (10, 500, 2)
    assert float(actions.min()) > -1
    assert float(actions.max()) < 1
    assert float(actions.square().mean()) == pytest.approx(1 / 3, abs=0.01)


def test_a_recording_that_was_stopped_goes_on_to_the_same_files(recording: RunReader, tmp_path):
    store, (stop, watchers) = Store(tmp_path), stopping_at(1500)
    stopped = train(config(), store, "a", rerun=False, watchers=watchers, stop=stop)
    assert (stopped.status.state, stopped.status.env_step) == ("stopped", 1500)
    assert find_unfinished(store, config()) == "a"
    assert find_unfinished(store, config(steps=1200)) is None
    with pytest.raises(UserError, match="its halves depend on them"):
        resume(store, "a", steps=1200, rerun=False)
    done = resume(store, "a", rerun=False)
    assert_same_record(recording, done)
    ours, theirs = (read_policy(run.path / "policy.npz") for run in (done, recording))
    obs = torch.randn(20, 11, generator=torch.Generator().manual_seed(1))
    assert torch.equal(ours.mean(obs), theirs.mean(obs))
