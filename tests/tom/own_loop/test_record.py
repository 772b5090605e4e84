"""`tom.record`: what a loop hands in is what `tom.load` gives back, whatever becomes of it."""

import errno
import os
import signal
import subprocess
import sys
import warnings
from contextlib import suppress
from pathlib import Path

import gymnasium
import numpy as np
import pandas as pd
import pytest
import torch
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from loops import Watched
from loops import loaded as load

import tom
from tom.errors import UserError
from tom.frames import Run
from tom.own_loop.rows import BLOCK
from tom.own_loop.run import OwnRun, record
from tom.policy.stored import read_policy
from tom.record import RunReader

FIELDS = ("obs", "action", "reward", "next_obs", "terminated", "truncated")
LIMIT = 7


def watched(env: str = "Pendulum-v1") -> Watched:
    return Watched(gymnasium.make(env, max_episode_steps=LIMIT))


def loaded(run: OwnRun) -> Run:
    return load(run.path.parent, run.name)


def column(table: pd.DataFrame, name: str) -> np.ndarray:
    if name in table:
        return table[name].to_numpy()
    return table[[c for c in table if str(c).rpartition("_")[0] == name]].to_numpy()


def same(table: pd.DataFrame, steps: list[tuple]) -> None:
    for name, values in zip(FIELDS, map(np.array, zip(*steps, strict=True)), strict=True):
        np.testing.assert_allclose(column(table, name), values, rtol=1e-5, atol=1e-5)


def played(run: OwnRun, env: gymnasium.Env, steps: int, seed: int = 0) -> None:
    obs, _ = env.reset(seed=seed)
    env.action_space.seed(seed)
    for _ in range(steps):
        action = env.action_space.sample()
        found = env.step(action)
        run.transitions(obs, action, found[1], found[0], found[2], found[3])
        obs = env.reset()[0] if found[2] or found[3] else found[0]


@pytest.mark.parametrize(("env", "block"), [("Pendulum-v1", 10), ("InvertedPendulum-v5", 1)])
def test_rows_come_back_as_they_were_handed_in(env: str, block: int, tmp_path: Path):
    one = watched(env)
    with record("mine", env=env, store=tmp_path, config={"lr": 1e-3}) as run:
        if block == 1:
            played(run, one, 40)
        else:
            with record("other", env=env, store=tmp_path) as other:
                played(other, one, 40)
            rows = [np.array(part) for part in zip(*one.steps, strict=True)]
            for first in range(0, 40, block):
                s, a, r, s2, end, cut = (part[first : first + block] for part in rows)
                run.transitions(s, a, r, s2, end, cut)
    found = loaded(run)
    same(found.transitions, one.steps)
    ended = [i + 1 for i, step in enumerate(one.steps) if step[4] or step[5]]
    returns = found.metrics["train/return"].dropna()
    assert returns.index.tolist() == ended
    episodes = np.split([step[2] for step in one.steps], ended)[: len(ended)]
    np.testing.assert_allclose(returns, [episode.sum() for episode in episodes], rtol=1e-6)
    assert found.reader.config["config"]["own"] == {"lr": 1e-3}
    assert not [n for n in found.reader.notices() if n["code"] != "few-rows"]


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_several_environments_give_whole_episodes(mode: AutoresetMode, tmp_path: Path):
    own = [watched() for _ in range(3)]
    envs = SyncVectorEnv([lambda one=one: one for one in own], autoreset_mode=mode)
    how = {"envs": 3, "autoreset": "next-step" if mode is AutoresetMode.NEXT_STEP else "same-step"}
    weights = np.random.default_rng(0).random(60)
    with record("mine", env="Pendulum-v1", store=tmp_path, **how) as run:
        obs, _ = envs.reset(seed=[1, 2, 3])
        envs.action_space.seed(0)
        rows = []  # as the loop has them, step by step and environment by environment
        for _ in range(20):
            action = envs.action_space.sample()
            after, reward, terminated, truncated, infos = envs.step(action)
            run.transitions(obs, action, reward, after, terminated, truncated, infos)
            rows += zip(obs, action, strict=True)
            obs = after
        run.weights(60, weights)
    table = loaded(run).transitions
    goes_on = ~(table["terminated"] | table["truncated"]).to_numpy()[:-1]
    seen, after = column(table, "obs"), column(table, "next_obs")
    np.testing.assert_allclose(after[:-1][goes_on], seen[1:][goes_on], atol=1e-6)  # whole episodes
    steps = [step for one in own for step in (*one.steps[:-1], (*one.steps[-1][:5], True))]
    order, wanted = np.lexsort(seen.T), np.lexsort(np.array([step[0] for step in steps]).T)
    same(table.iloc[order], [steps[i] for i in wanted])  # what was not over is cut
    # Each weight stands beside the row that it was given for.
    kept = loaded(run).weights()["weight"].to_numpy()
    by_row = {(*map(float, o), *map(float, a)): w for (o, a), w in zip(rows, weights, strict=True)}
    given = [
        by_row[min(by_row, key=lambda key: np.abs(np.array(key) - (*o, *a)).max())]
        for o, a in zip(column(table, "obs"), column(table, "action"), strict=True)
    ][: len(kept)]
    np.testing.assert_allclose(kept, np.array(given) / np.mean(given), rtol=1e-5)


def test_weights_metrics_and_replays_come_back(tmp_path: Path):
    one, given = watched("Hopper-v5"), np.arange(30.0)
    with record("mine", env="Hopper-v5", store=tmp_path) as run:
        played(run, one, 40)
        run.weights(40, given)  # a buffer that has dropped the oldest ten
        run.metrics(40, {"my/loss": np.float32(0.5)})
        qpos, qvel = np.random.default_rng(0).random((2, 4, 6))
        run.episode(40, (qpos, qvel), [1, 2, 3])
        run.episode(40, qvel[:, :1].repeat(11, 1), [1.0, 2, 6])
        run.metrics(41, {"eval/return": 812.0})
        run.episode(41, (qpos, qvel), [1, 2, 3])
    found = loaded(run)
    assert found.name == "mine"
    assert found.reader.env == "hopper"
    np.testing.assert_allclose(found.weights()["weight"], given / given.mean(), rtol=1e-6)
    rows = found.rows()
    assert rows["row"].tolist() == list(range(10, 40))
    np.testing.assert_allclose(rows["reward"], [step[2] for step in one.steps[10:]], rtol=1e-5)
    assert found.metrics["my/loss"].dropna().tolist() == [0.5]
    first, second = found.reader.episodes(40)
    assert first.qpos is not None
    assert second.qpos is not None
    np.testing.assert_allclose(first.qpos, qpos, rtol=1e-6)
    np.testing.assert_allclose(first.obs[:, 5:], qvel, rtol=1e-6)
    np.testing.assert_allclose(second.qpos[:, 1:], second.obs[:, :5])
    assert len(found.reader.episodes(41)) == 1
    assert found.metrics["eval/return"].dropna().tolist() == [(6 + 9) / 2, 812]
    assert found.reader.status.last_return == 812


def test_policies_that_were_kept_stay_when_weights_follow(tmp_path: Path):
    one = watched()
    with record("mine", env="Pendulum-v1", store=tmp_path) as run:
        for step in range(10, 70, 10):
            played(run, one, 10)
            if step % 20 == 0:
                run.policy(step, in_units)
            run.weights(step, np.ones(step))
    assert loaded(run).reader.policy_steps() == [20, 40, 60]


def test_any_run_id_is_also_its_name(tmp_path: Path):
    with record("x" * 100, env="Pendulum-v1", store=tmp_path) as run:
        pass
    assert loaded(run).reader.labels.name == "x" * 100


def test_a_program_that_ends_without_an_error_has_finished_its_record(tmp_path: Path):
    for code, state in ((0, "finished"), (None, "finished"), (3, "failed")):
        with suppress(SystemExit), record(f"code-{code}", env="Pendulum-v1", store=tmp_path) as run:
            sys.exit(code)
        assert loaded(run).reader.status.state == state


def test_what_is_cut_off_counts_as_no_best_return(tmp_path: Path):
    one = watched()
    with record("mine", env="Pendulum-v1", store=tmp_path) as run:
        for step, value in ((10, -100.0), (20, -10.0)):
            played(run, one, 10)
            run.metrics(step, {"eval/return": value})
    with record("mine", env="Pendulum-v1", store=tmp_path, resume="auto", step=15) as run:
        run.metrics(15, {"eval/return": -90.0})
    found = loaded(run)
    assert found.metrics["eval/return_max"].dropna().tolist() == [-100, -90]
    assert found.reader.status.best_return == -90


def test_the_best_return_is_of_whole_evaluations(tmp_path: Path):
    with record("mine", env="Pendulum-v1", store=tmp_path) as run:
        for step, returns in ((10, (100.0, 0.0)), (20, (60.0, 64.0)), (30, (70.0, 0.0))):
            for reward in returns:
                run.episode(step, np.zeros((2, 3)), [reward])
    found = loaded(run)
    assert found.metrics["eval/return"].tolist() == [50, 62, 35]
    assert found.metrics["eval/return_max"].tolist() == [50, 62, 62]
    status = found.reader.status
    assert (status.last_return, status.best_return) == (35, 62)


def test_an_evaluation_plays_as_many_episodes_as_it_is_asked_for(tmp_path: Path):
    with record("mine", env="InvertedPendulum-v5", store=tmp_path) as run:
        played(run, gymnasium.make("InvertedPendulum-v5"), 20)
        run.policy(20, lambda obs: np.zeros((len(obs), 1)))
        for step, episodes in ((20, 1), (30, 3), (40, 2)):
            run.evaluate(step, episodes)
    reader = loaded(run).reader
    assert [len(reader.episodes(step)) for step in (20, 30, 40)] == [1, 3, 2]


KILLED = """
import sys
import numpy as np
from tom.own_loop.run import record
run = record("mine", env="Pendulum-v1", store=sys.argv[1])
for step in range(1, 10_001):
    run.transitions([step, 0, 0], [0], step, [step + 1, 0, 0], False, step % 100 == 0)
    if step % 100 == 0:
        run.metrics(step, {"my/step": step})
        run.weights(step, np.arange(step) + 1)
print("there", flush=True)
input()
"""


def test_a_killed_loop_goes_on_where_it_says(tmp_path: Path):
    child = subprocess.Popen(
        [sys.executable, "-c", KILLED, str(tmp_path)],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, cwd=Path(tom.__file__).parents[1],
    )  # fmt: skip
    assert child.stdout is not None
    assert child.stdout.readline() == b"there\n"
    os.kill(child.pid, signal.SIGKILL)
    child.communicate()
    with pytest.raises(UserError):
        record("mine", env="Pendulum-v1", store=tmp_path)
    with record("mine", env="Pendulum-v1", store=tmp_path, resume="auto", step=5050) as run:
        assert run.step == 5050
        for step in range(5051, 6001):
            run.transitions([-step, 0, 0], [0], -step, [-step - 1, 0, 0], False, step % 100 == 0)
        run.weights(6000, np.ones(6000))
    found = loaded(run)
    reward = np.arange(1, 6001.0)
    reward[5050:] *= -1
    np.testing.assert_array_equal(found.transitions["reward"], reward)
    ends = np.flatnonzero(found.transitions["truncated"]) + 1
    assert ends.tolist() == sorted([*range(100, 6001, 100), 5050])
    assert found.metrics["my/step"].dropna().index.tolist() == list(range(100, 5001, 100))
    assert found.reader.snapshot_steps()[-1] == 6000
    assert str(found.summary["state"]) == "finished"


def test_an_episode_is_cut_at_the_border_of_two_files_as_well(tmp_path: Path):
    def hand_in(run: OwnRun, first: int, rows: int) -> None:
        at = np.arange(first, first + rows)[:, None] + np.zeros(3)
        no = np.zeros(rows, bool)
        run.transitions(at, np.zeros((rows, 1)), np.ones(rows), at + 1, no, no)

    with record("mine", env="Pendulum-v1", store=tmp_path) as run:
        for _ in range(3):
            hand_in(run, run.step, BLOCK)
    assert len([*(run.path / "buffer").iterdir()]) == 3
    cut = 2 * BLOCK
    with record("mine", env="Pendulum-v1", store=tmp_path, resume="auto", step=cut) as run:
        hand_in(run, 0, 10)
    ends = np.flatnonzero(loaded(run).transitions["truncated"]) + 1
    assert ends.tolist() == [cut]


def test_rows_of_several_environments_are_cut_in_all_files(tmp_path: Path):
    def hand_in(run: OwnRun, steps: int) -> None:
        number = run.step + 1 + np.arange(3 * steps).reshape(steps, 3)
        at, no = number[..., None] + np.zeros(3), np.zeros((steps, 3), bool)
        cut = no.copy()
        cut[-1] = True
        run.transitions(at, np.zeros((steps, 3, 1)), number, at + 3, no, cut)

    with record("mine", env="Pendulum-v1", store=tmp_path, envs=3) as run:
        hand_in(run, BLOCK)
    assert len([*(run.path / "buffer").iterdir()]) == 3  # one environment's rows in each
    with record("mine", env="Pendulum-v1", store=tmp_path, envs=3, resume="auto", step=6000) as run:
        hand_in(run, 10)
    found = loaded(run)
    assert sorted(found.transitions["reward"]) == [*range(1, 6031)]
    ends = np.flatnonzero(found.transitions["truncated"]) + 1
    assert ends.tolist() == [2000, 4000, 6000, 6010, 6020, 6030]
    assert not found.reader.problems


BAD = {
    "transitions": [
        ([0, 0], [0], 0, [0, 0, 0], False, False),
        ([[0, 0, 0]] * 2, [[0]] * 2, [0, np.nan], [[0, 0, 0]] * 2, [0, 0], [0, 0]),
    ],
    "weights": [(10, np.ones(11)), (10, [-1.0] + [1] * 9)],
    "metrics": [(9, {"a": 1}), (10, {"a": "b"})],
    "episode": [(10, np.zeros((3, 3)), [1.0])],
    "policy": [(10, 3)],
}


@pytest.mark.parametrize("strict", [False, True])
def test_what_does_not_fit_is_left_out_in_one_line(strict: bool, tmp_path: Path):
    with record("mine", env="Pendulum-v1", store=tmp_path, strict=strict) as run:
        for step in range(10):
            run.transitions([step, 0, 0], [0], 0, [step + 1, 0, 0], False, False)
        run.metrics(10, {"a": 1})
        for what, given in ((what, given) for what, all_ in BAD.items() for given in all_):
            if strict:
                with pytest.raises(UserError) as error:
                    getattr(run, what)(*given)
                assert "\n" not in str(error.value)
            else:
                with pytest.warns(UserWarning, match="not recorded"):
                    getattr(run, what)(*given)
        run.transitions([10, 0, 0], [0], 0, [11, 0, 0], False, False)
    found = loaded(run)
    assert len(found.transitions) == 11
    assert found.metrics["a"].tolist() == [1]
    assert not found.reader.snapshot_steps()
    assert not found.reader.evaluation_steps()
    assert not found.reader.problems
    assert strict or "not-recorded" in {n["code"] for n in found.reader.notices()}


def full(*_: object, **__: object) -> None:
    raise OSError(errno.ENOSPC, "No space left on device")


def test_a_full_disk_ends_the_record_and_not_the_loop(tmp_path: Path, monkeypatch):
    run = record("mine", env="Pendulum-v1", store=tmp_path)
    run.transitions([0, 0, 0], [0], 0, [1, 0, 0], False, False)

    monkeypatch.setattr(np, "savez", full)
    with pytest.warns(UserWarning, match="No space left"):
        run.weights(1, [1.0])
    monkeypatch.undo()
    with warnings.catch_warnings(action="error"):
        run.transitions([1, 0, 0], [0], 0, [2, 0, 0], False, False)
        run.close()
    assert str(loaded(run).summary["state"]) == "failed"
    with record("mine", env="Pendulum-v1", store=tmp_path, resume="auto") as run:
        run.transitions([1, 0, 0], [0], 0, [2, 0, 0], False, False)
    assert str(loaded(run).summary["state"]) == "finished"


def gaussian(obs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    mean = obs[:, :1] - 0.3 * obs[:, 1:2]
    return mean, torch.full_like(mean, -1.0)


def in_units(obs: np.ndarray) -> np.ndarray:
    """Deterministic, in the task's own units, which are twice the agents'."""
    return 2 * np.tanh(obs[:, :1] - 0.3 * obs[:, 1:2])


class Module(torch.nn.Module):
    def forward(self, obs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return gaussian(obs)


def test_a_record_that_a_full_disk_ends_names_no_command_that_refuses_it(tmp_path, monkeypatch):
    run = record("mine", env="Pendulum-v1", store=tmp_path)
    run.transitions([0, 0, 0], [0], 0, [1, 0, 0], False, False)

    monkeypatch.setattr(np, "savez", full)
    run.close()
    status = RunReader(run.path).status
    assert status.state == "failed"
    assert "tom train" not in status.reason


@pytest.mark.parametrize("policy", [in_units, Module(), lambda obs: gaussian(torch.tensor(obs))])
def test_any_policy_is_kept_as_a_network_that_answers_like_it(policy, tmp_path: Path):
    rng = np.random.default_rng(0)
    angle = rng.uniform(-np.pi, np.pi, 1000)
    obs = np.stack((np.cos(angle), np.sin(angle), rng.uniform(-8, 8, 1000)), 1)
    with record("mine", env="Pendulum-v1", store=tmp_path) as run:
        for rows in (slice(999), slice(999, 1000)):  # the newest block is a single row
            n = len(obs[rows])
            run.transitions(obs[rows], np.zeros((n, 1)), angle[rows], obs[rows], [0] * n, [1] * n)
            run.weights(rows.stop, np.ones(rows.stop))
        run.policy(1000, policy)
    own, action = obs, in_units(obs) / 2
    kept = read_policy(run.path / "policy.npz")
    seen = torch.from_numpy((own / [1, 1, 8]).astype(np.float32))
    assert np.abs(kept.mean(seen).numpy() - action).mean() < 0.05
    error = loaded(run).metrics["policy/copy_error"].dropna().tolist()[0]
    assert error < 0.1
    distance = loaded(run).rows()["policy_distance"]
    np.testing.assert_allclose(distance, np.abs(action[:, 0]), atol=0.25)


def test_the_noise_of_a_policy_is_no_error_of_its_copy(tmp_path: Path):
    def noisy(obs: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(in_units(obs)) + torch.randn(len(obs), 1)

    rng = np.random.default_rng(0)
    angle = rng.uniform(-np.pi, np.pi, 1000)
    obs = np.stack((np.cos(angle), np.sin(angle), rng.uniform(-8, 8, 1000)), 1)
    with record("mine", env="Pendulum-v1", store=tmp_path) as run:
        run.transitions(obs, np.zeros((1000, 1)), angle, obs, [0] * 1000, [1] * 1000)
        run.policy(1000, noisy)
    assert loaded(run).metrics["policy/copy_error"].dropna().tolist()[0] < 0.1


def test_a_policy_is_kept_before_the_first_episode_of_several_environments_ends(tmp_path: Path):
    obs, ends = np.random.default_rng(0).uniform(-1, 1, (50, 2, 3)), np.zeros((50, 2), bool)
    obs[..., :2] /= np.linalg.norm(obs[..., :2], axis=-1, keepdims=True)
    with record("mine", env="Pendulum-v1", store=tmp_path, envs=2, strict=True) as run:
        with pytest.raises(UserError):
            run.policy(0, in_units)  # no observation to ask it about
        run.transitions(obs, np.zeros((50, 2, 1)), np.zeros((50, 2)), obs, ends, ends)
        run.policy(100, in_units)
    kept, own = read_policy(run.path / "policies/000000100.npz"), obs.reshape(-1, 3)
    seen = torch.from_numpy((own / [1, 1, 8]).astype(np.float32))
    assert np.abs(kept.mean(seen).numpy() - in_units(own) / 2).mean() < 0.05
