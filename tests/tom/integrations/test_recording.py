"""Trainings of other libraries, recorded while they run or exported: real ones, and short."""

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers import RecordEpisodeStatistics
from gymnasium.wrappers.vector import RecordEpisodeStatistics as RecordStatistics
from loops import Watched, loaded
from ray.rllib.policy.sample_batch import SampleBatch
from ray.rllib.utils.replay_buffers.prioritized_replay_buffer import PrioritizedReplayBuffer
from stable_baselines3 import PPO, SAC, TD3
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from tom.data.datasets import read_dataset
from tom.data.transitions import Transitions
from tom.errors import UserError
from tom.integrations.gymnasium import RecordEnv, RecordVectorEnv
from tom.integrations.rllib import priorities
from tom.integrations.sb3 import RecordCallback, export_buffer, export_policy
from tom.own_loop.opening import resolve_task
from tom.own_loop.policy import PolicyCopier, _as_function
from tom.own_loop.run import record
from tom.policy.foreign import ForeignPolicy
from tom.policy.stored import StoredPolicy, read_policy


def small(kind, env, **options):
    """A model that learns quickly."""
    return kind("MlpPolicy", env, policy_kwargs={"net_arch": [8, 8]}, seed=0, **options)


def pendulum(limit: int = 30) -> gymnasium.Env:
    return gymnasium.make("Pendulum-v1", max_episode_steps=limit)


@pytest.mark.parametrize(
    ("kind", "normalised", "envs"),
    [pytest.param(SAC, False, 1, marks=pytest.mark.slow), (SAC, True, 2), (TD3, True, 1)],
)
def test_a_training_of_sb3_is_recorded_as_it_is(kind, normalised, envs, tmp_path: Path):
    env: Any = DummyVecEnv([pendulum] * envs)
    env = VecNormalize(env) if normalised else env
    model = small(kind, env, learning_starts=20, batch_size=16)
    callback = RecordCallback("mine", store=str(tmp_path), weigh=(), every=60, episodes=2)
    model.learn(120, callback=callback, log_interval=1)
    run = loaded(tmp_path)
    export_buffer(model, tmp_path / "buffer.npz")
    kept, table = read_dataset(tmp_path / "buffer.npz").rows, run.transitions
    order = np.lexsort(table[["obs_0", "obs_2", "reward"]].to_numpy().T)
    other = np.lexsort(np.column_stack((kept.obs[:, [0, 2]], kept.reward)).T)
    for name in ("reward", "terminated", "truncated"):
        values = np.asarray(getattr(kept, name))[other]
        np.testing.assert_allclose(table[name][order], values, rtol=1e-4)
    for name in ("obs", "next_obs", "action"):
        columns = [c for c in table if str(c).rpartition("_")[0] == name]
        found = table[columns].to_numpy()[order]
        np.testing.assert_allclose(found, getattr(kept, name)[other], rtol=1e-3, atol=1e-4)
    # The kept policy and critics are the model's own.
    policy = read_policy(run.reader.path / "policy.npz")
    obs = np.asarray(kept.obs, np.float32)
    expected = model.predict(env.normalize_obs(obs) if normalised else obs, deterministic=True)[0]
    unit = torch.from_numpy(obs / np.array([1, 1, 8], np.float32))
    np.testing.assert_allclose(2 * policy.mean(unit), expected, atol=1e-3)
    assert policy.value_gradient is not None
    assert run.reader.evaluation_steps() == [60, 120]
    assert len(run.reader.episodes(120)) == 2
    assert {"critic/loss", "eval/return", "train/return"} <= {*run.metrics}


def test_a_model_that_is_loaded_goes_on_with_its_run(tmp_path: Path):
    def callback() -> RecordCallback:
        return RecordCallback("mine", store=str(tmp_path), weigh=(), every=50, episodes=0)

    model = small(SAC, pendulum(), learning_starts=20, batch_size=16)
    model.learn(70, callback=callback())
    model.save(tmp_path / "model.zip")
    model.learn(100, callback=callback(), reset_num_timesteps=False)  # lost: it was killed
    again = SAC.load(tmp_path / "model.zip", env=pendulum())
    again.learn(60, callback=callback(), reset_num_timesteps=False)
    run = loaded(tmp_path)
    assert len(run.transitions) == 130
    assert str(run.summary["state"]) == "finished"
    assert run.reader.policy_steps() == [50, 70, 120, 130]
    assert run.transitions["truncated"].to_numpy().nonzero()[0].tolist() == [29, 59, 69, 99, 129]


def test_a_policy_of_ppo_is_learnt_from_its_answers(tmp_path: Path):
    model = small(PPO, DummyVecEnv([pendulum] * 2), n_steps=64)
    callback = RecordCallback("mine", store=str(tmp_path), weigh=(), every=128, episodes=0)
    model.learn(256, callback=callback)
    run = loaded(tmp_path)
    assert len(run.transitions) == 256
    assert np.abs(run.transitions["action_0"].to_numpy()).max() <= 2
    # Its answers are draws, whose noise the copy averages over the rows.
    obs = run.transitions[["obs_0", "obs_1", "obs_2"]].to_numpy()
    expected = model.predict(obs, deterministic=True)[0] / 2
    kept = read_policy(run.reader.path / "policy.npz")
    found = kept.mean(torch.from_numpy(obs / np.array([1, 1, 8], np.float32))).numpy()
    assert np.sqrt(np.square(found - expected).mean()) < 0.25
    assert float(run.metrics["policy/copy_error"].dropna().tolist()[-1]) < 0.25


class Features(BaseFeaturesExtractor):
    """As many features as a pendulum has observations."""

    def __init__(self, space: gymnasium.Space) -> None:
        super().__init__(space, 3)
        self.net = torch.nn.Linear(3, 3)

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        return torch.tanh(self.net(observations))


@pytest.mark.parametrize("kind", ["normalised", "features", "quantiles"])
def test_a_model_of_another_form_is_kept_as_it_acts(kind: str):
    env: Any = DummyVecEnv([pendulum])
    model: Any
    if kind == "normalised":
        env = VecNormalize(env)
        env.obs_rms.mean, env.obs_rms.var = np.array([0, 0, 3.0]), np.array([0.5, 0.5, 16])
        model = small(PPO, env, n_steps=64)
    else:
        model = small(SAC, env, buffer_size=10)
    with torch.no_grad():
        match kind:
            case "normalised":
                model.policy.action_net.weight *= 100
                model.policy.log_std -= 3
            case "features":
                model.actor.features_extractor = Features(model.observation_space)
                model.actor.mu.weight *= 30
                model.actor.log_std.bias -= 4
            case "quantiles":  # as of TQC's critics
                wide = [torch.nn.Sequential(*net[:-1], torch.nn.Linear(8, 25))
                        for net in model.critic.q_networks]  # fmt: skip
                model.critic.q_networks = wide
    angle, known = np.linspace(-3, 3, 1000), resolve_task("Pendulum-v1")
    obs = np.stack((np.cos(angle), np.sin(angle), 6 * np.sin(7 * angle)), 1).astype(np.float32)
    seen = known.unit_obs(obs)
    kept = StoredPolicy(PolicyCopier(known).copy(model, seen)[0])
    asked = env.normalize_obs(obs) if kind == "normalised" else obs
    expected = model.predict(asked, deterministic=True)[0]
    assert np.abs(2 * kept.mean(torch.from_numpy(seen)).numpy() - expected).mean() < 0.06
    assert kept.value_gradient is None


@pytest.mark.parametrize(("kind", "options"), [(SAC, {"buffer_size": 10}), (PPO, {"n_steps": 64})])
def test_noise_of_the_state_is_drawn_anew_and_no_part_of_the_mean(kind, options):
    model = small(kind, DummyVecEnv([pendulum]), use_sde=True, **options)
    part = model.actor if kind is SAC else model.policy
    with torch.no_grad():
        part.log_std.fill_(-1.0)
    part.reset_noise()
    known, obs = resolve_task("Pendulum-v1"), np.random.default_rng(0).normal(size=(50, 3))
    seen = torch.from_numpy(known.unit_obs(obs))
    policy = ForeignPolicy("of gSDE", _as_function(model), known)
    drawn = policy(seen, 200, torch.Generator().manual_seed(0))
    assert float(drawn.std(0).mean()) > 0.02
    if kind is SAC:
        expected = model.predict(obs.astype(np.float32), deterministic=True)[0]
        np.testing.assert_allclose(2 * policy.mean(seen), expected, atol=1e-4)


def test_an_environment_records_itself(tmp_path: Path):
    env = RecordEnv(RecordEpisodeStatistics(pendulum()), "mine", store=tmp_path)
    returns = []
    for seed in range(3):
        env.reset(seed=seed)
        ended, info = False, {}
        while not ended:
            _, _, terminated, truncated, info = env.step(env.action_space.sample())
            ended = terminated or truncated
        returns.append(info["episode"]["r"])
    env.close()
    run = loaded(tmp_path)
    np.testing.assert_allclose(run.metrics["train/return"].dropna(), returns, rtol=1e-5)
    assert run.transitions["truncated"].to_numpy().nonzero()[0].tolist() == [29, 59, 89]


@pytest.mark.parametrize("flushed", [False, True])
def test_a_reset_cuts_the_episode(flushed: bool, tmp_path: Path):
    env = RecordEnv(pendulum(), "mine", store=tmp_path, strict=True)
    for steps in (10, 5, 30):
        env.reset(seed=0)
        for _ in range(steps):
            env.step(env.action_space.sample())
        if flushed:  # the rows are in the record by then
            env.run.weights(env.run.step, np.ones(env.run.step))
    env.reset()
    env.close()
    run = loaded(tmp_path)
    assert run.transitions["truncated"].to_numpy().nonzero()[0].tolist() == [9, 14, 44]
    rewards = run.transitions["reward"].to_numpy()
    np.testing.assert_allclose(
        run.metrics["train/return"].dropna(), [rewards[15:].sum()], rtol=1e-5
    )


@pytest.mark.parametrize("mode", list(AutoresetMode)[:2])
def test_a_reset_cuts_the_episodes_of_a_vector(mode: AutoresetMode, tmp_path: Path):
    envs = gymnasium.make_vec(
        "Pendulum-v1", num_envs=2, max_episode_steps=8, vector_kwargs={"autoreset_mode": mode}
    )
    envs = RecordVectorEnv(envs, "mine", store=tmp_path, strict=True)
    for steps in (5, 8, 3):
        envs.reset(seed=0)
        for _ in range(steps):
            envs.step(envs.action_space.sample())
    envs.close()
    truncated = loaded(tmp_path).transitions["truncated"].to_numpy()
    assert truncated.nonzero()[0].tolist() == [4, 9, 17, 25, 28, 31]


@pytest.mark.parametrize("mode", list(AutoresetMode)[:2])
def test_a_vector_of_environments_records_itself(mode: AutoresetMode, tmp_path: Path):
    envs = gymnasium.make_vec(
        "Pendulum-v1", num_envs=3, max_episode_steps=20, vector_kwargs={"autoreset_mode": mode}
    )
    envs = RecordVectorEnv(RecordStatistics(envs), "mine", store=tmp_path)
    envs.reset(seed=0)
    returns = []
    for _ in range(65):
        infos = envs.step(envs.action_space.sample())[-1]
        if "episode" in infos:
            returns += infos["episode"]["r"][infos["_episode"]].tolist()
    envs.close()
    table = loaded(tmp_path).transitions
    ends = (table["terminated"] | table["truncated"]).to_numpy().nonzero()[0]
    totals = [part.sum() for part in np.split(table["reward"].to_numpy(), ends + 1)]
    assert len(returns) == 9
    whole = [np.float32(r) for r in totals if min(abs(r - x) for x in returns) < 1e-2]
    np.testing.assert_allclose(sorted(whole), sorted(returns), rtol=1e-4)


def test_observations_that_the_environment_changes_in_place_are_recorded_as_they_were(
    tmp_path: Path,
):
    envs: Any = gymnasium.make_vec("Pendulum-v1", num_envs=2, vector_kwargs={"copy": False})
    envs = RecordVectorEnv(envs, "mine", store=tmp_path)
    seen = [envs.reset(seed=0)[0].copy()]
    for _ in range(4):
        seen.append(envs.step(envs.action_space.sample())[0].copy())
    envs.close()
    table = loaded(tmp_path).transitions
    for name, rows in (("obs", seen[:-1]), ("next_obs", seen[1:])):
        wanted = np.array(rows).transpose(1, 0, 2).reshape(-1, 3)  # an environment, then the other
        found = table[[f"{name}_{i}" for i in range(3)]]
        np.testing.assert_allclose(found, wanted, rtol=1e-5, atol=1e-6)


def test_priorities_of_rllib_are_the_weights(tmp_path: Path):
    buffer = PrioritizedReplayBuffer(capacity=20, storage_unit="timesteps", alpha=0.5)
    rng, given = np.random.default_rng(0), {}
    with record("mine", env="Pendulum-v1", store=tmp_path) as run:
        for step in range(30):
            run.transitions([step, 0, 0], [0], step, [step + 1, 0, 0], False, False)
            row = {"obs": [np.ones(3) * step], "step": [step]}
            buffer.add(SampleBatch(row), weight=1.0)
            if step >= 8:
                drawn: Any = buffer.sample(4, beta=0.4)
                new = (rng.random(4) + 0.1).tolist()
                buffer.update_priorities(drawn["batch_indexes"], new)
                given |= dict(zip(drawn["step"].tolist(), new, strict=True))
        run.weights(30, priorities(buffer))
    expected = np.array([given.get(step, 1.0) for step in range(10, 30)]) ** 0.5
    found = loaded(tmp_path).rows()
    assert found["reward"].tolist() == list(range(10, 30))
    np.testing.assert_allclose(found["weight"], expected / expected.mean(), rtol=1e-5)


# Buffers and policies of stable-baselines3, exported: what was done in the task, row for row

LIMITS = {"Pendulum-v1": 40, "InvertedPendulum-v5": 30}


def learnt(env: str, steps: int, envs: int = 1, size: int = 1000, **options: Any):
    """A model after `steps` steps in each of its environments, and what these have noted."""
    watched = [Watched(gymnasium.make(env, max_episode_steps=LIMITS[env])) for _ in range(envs)]
    together = DummyVecEnv([lambda one=one: one for one in watched])
    model = SAC(
        "MlpPolicy", together, learning_starts=90 * envs,
        buffer_size=size, batch_size=16, seed=0, policy_kwargs={"net_arch": [8]}, **options,
    )  # fmt: skip
    model.learn(steps * envs)
    return model, [one.steps for one in watched]


def same(rows: Transitions, steps: list[tuple]) -> None:
    """The rows are these steps; whatever comes last is the end of an episode."""
    obs, action, reward, next_obs, terminated, truncated = map(np.array, zip(*steps, strict=True))
    truncated[-1] |= not terminated[-1]
    for name, values in {
        "obs": obs,
        "action": action,
        "next_obs": next_obs,
        "reward": reward,
    }.items():
        np.testing.assert_allclose(getattr(rows, name), values, rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal(rows.terminated, terminated)
    np.testing.assert_array_equal(rows.truncated, truncated & ~terminated)


@pytest.mark.parametrize("env", ["Pendulum-v1", "InvertedPendulum-v5"])
def test_a_buffer_is_what_was_done_in_each_environment(env: str, tmp_path: Path):
    model, steps = learnt(env, 110, 3)
    export_buffer(model, tmp_path / "buffer.npz")
    recording = read_dataset(tmp_path / "buffer.npz")
    for number, own in enumerate(steps):
        same(recording.rows[number * 110 : (number + 1) * 110], own)
    assert np.abs(recording.rows.action).max() > 1  # in the task's own units
    assert recording.card.notices() == ()
    # Rows of one step have one policy, whichever environment they are of.
    assert recording.policy_version is not None
    assert recording.policy_version.tolist() == [*range(1, 111)] * 3


def test_a_full_buffer_begins_with_its_oldest_row(tmp_path: Path):
    model, [steps] = learnt("Pendulum-v1", 110, size=75)
    export_buffer(model, tmp_path / "whole.npz")
    same(read_dataset(tmp_path / "whole.npz").rows, steps[-75:])


@pytest.mark.parametrize("kind", [SAC, TD3])
def test_an_exported_policy_takes_the_observations_of_the_exported_buffer(kind, tmp_path: Path):
    env = VecNormalize(DummyVecEnv([pendulum]), clip_obs=1.5)
    model = small(kind, env, learning_starts=20, batch_size=16)
    model.learn(60)
    export_buffer(model, tmp_path / "buffer.npz")
    export_policy(model, tmp_path / "policy.pt")
    obs = np.asarray(read_dataset(tmp_path / "buffer.npz").rows.obs, np.float32)
    seen: Any = env.normalize_obs(obs)
    assert np.abs(seen - obs).max() > 1
    found = torch.jit.load(tmp_path / "policy.pt")(torch.from_numpy(obs))
    action = 2 * torch.tanh(found[0]) if kind is SAC else found
    expected = model.predict(seen, deterministic=True)[0]
    np.testing.assert_allclose(action.detach(), expected, atol=1e-4)


def test_a_buffer_without_the_ends_of_episodes_is_refused(tmp_path: Path):
    model, _ = learnt("Pendulum-v1", 5, replay_buffer_kwargs={"handle_timeout_termination": False})
    with pytest.raises(UserError, match="handle_timeout_termination"):
        export_buffer(model, tmp_path / "buffer.npz")


@pytest.mark.parametrize(("kind", "options"), [(SAC, {}), (SAC, {"use_sde": True}), (TD3, {})])
def test_an_exported_policy_is_the_models(kind, options, tmp_path: Path):
    policy = {"net_arch": [8]} | ({"log_std_init": -1.0} if options else {})
    env = gymnasium.make("Pendulum-v1")
    model = kind("MlpPolicy", env, seed=0, buffer_size=10, policy_kwargs=policy, **options)
    model.actor.train()
    export_policy(model, tmp_path / "policy.pt")
    assert model.actor.training  # the model goes on as it was
    obs = np.random.default_rng(0).normal(size=(5, 3)).astype(np.float32)
    found = torch.jit.load(tmp_path / "policy.pt")(torch.from_numpy(obs))
    action = 2 * torch.tanh(found[0]) if kind is SAC else found
    expected = model.predict(obs, deterministic=True)[0]
    np.testing.assert_allclose(action.detach(), expected, atol=1e-5)
    if options:  # the spread of the state's own noise
        torch.manual_seed(0)
        own = model.policy.obs_to_tensor(np.repeat(obs[:1], 4000, 0))[0]
        model.actor.reset_noise(4000)
        drawn = torch.atanh(model.actor(own).detach().clamp(-0.9999, 0.9999))
        np.testing.assert_allclose(drawn.std(), found[1][0].exp().detach(), rtol=0.1)
