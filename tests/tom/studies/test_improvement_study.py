"""What weights do for the policy: SAC goes on from a kept policy in models of the frozen buffer."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

from tom.cli import main
from tom.config import OnlineConfig
from tom.data.transitions import TensorTransitions
from tom.data.unpack import read_arrays
from tom.policy.stored import StoredPolicy, policy_arrays, resumed_sac
from tom.record import RunReader, layout
from tom.studies import improvement as study
from tom.studies.frozen import WAYS, Case, Way, moments
from tom.studies.improvement import improve, in_sentences, summary
from tom.studies.study import Row


def test_sac_goes_on_with_the_stored_networks(run: RunReader):
    arrays = dict(read_arrays(run.path / layout.policy(moments(run, 1)[0])))
    config = OnlineConfig.model_validate(run.config["config"]).sac
    policy = StoredPolicy(arrays)
    sac = resumed_sac(policy, config, 0.25, torch.Generator().manual_seed(0))
    for name, array in policy_arrays("hopper", sac).items():
        assert np.array_equal(array, arrays[name]), name
    obs, action = torch.randn(7, 11), torch.rand(7, 3) * 2 - 1
    assert torch.equal(sac.policy.mean(obs), policy.mean(obs))
    inputs = torch.cat([obs, action], -1).expand(2, -1, -1)
    assert torch.equal(sac.critic(inputs), sac.target_critic(inputs))
    assert sac.log_temperature.exp().item() == pytest.approx(0.25)
    batch = TensorTransitions(
        obs, action, torch.zeros(7), obs.clone(), torch.zeros(7), torch.zeros(7)
    )
    before = sac.critic(inputs).clone()
    sac.updates(batch.packed()[None])
    assert not torch.equal(sac.critic(inputs), before)
    assert policy.critic is not None
    assert torch.equal(policy.critic(inputs), before)  # the file's own networks


def trial(run: RunReader, way: str) -> Case:
    at = moments(run, 1)[0]
    return Case(run.path, at, way, models=("linear",), updates=20, episodes=2)


def test_weights_act_in_the_model_in_the_starts_or_in_both(run: RunReader):
    plain, newest = improve(trial(run, "uniform")), improve(trial(run, "newest"))
    assert plain["model"] == plain["starts"] == plain["both"]
    assert plain["both"] != plain["before"]
    assert newest["before"] == plain["before"]  # the same policy and start states
    assert len({newest["model"], newest["starts"], newest["both"], plain["both"]}) == 4
    assert improve(trial(run, "newest")) == newest


@pytest.mark.parametrize(
    "way",
    ["pdml", *(pytest.param(way, marks=pytest.mark.slow) for way in ("action-ratio", "pmer"))],
)
def test_ways_that_train_no_network_act_in_both_places_alone_and_half(run: RunReader, way: str):
    plain = improve(trial(run, "uniform"))
    alone, half = improve(trial(run, way)), improve(trial(run, f"half-{way}"))
    for place in ("model", "starts"):
        assert np.isfinite([alone[place], half[place]]).all()
        assert len({plain["both"], alone[place], half[place]}) == 3, place
    assert alone["both"] not in (alone["model"], alone["starts"])


def test_weights_of_one_change_nothing_anywhere(run: RunReader, monkeypatch: pytest.MonkeyPatch):
    one = {"uniform_share": 1.0}
    monkeypatch.setitem(WAYS, "even", Way("ratio", {"model": one, "rollout": one}))
    plain, even = improve(trial(run, "uniform")), improve(trial(run, "even"))
    assert even == dict(plain, way="even")


def test_the_temperature_between_two_records_is_interpolated_in_logarithms():
    steps, values = np.array([1000, 3000, 4000]), np.array([1.0, 0.25, 0.1])
    assert study.temperature_at(2000, steps, values) == pytest.approx(0.5)
    assert study.temperature_at(4000, steps, values) == pytest.approx(0.1)
    assert study.temperature_at(9000, steps, values) == pytest.approx(0.1)


BASE: Row = {"recording": "a", "env": "hopper", "step": 100, "way": "uniform", "seed": 0}
BASE |= {"before": 90, "model": 110, "starts": 110, "both": 110}


def recorded(recording: str, env: str, *gains: float) -> list[Row]:
    """Trials of one recording with uniform weights and with a way that gains so much in both."""
    found = []
    for seed, gain in enumerate(gains):
        plain = dict(BASE, recording=recording, env=env, seed=seed)
        way = dict(plain, way="ratio", model=60, starts=110, both=110 + gain)
        found += [plain, way]
    return found


def test_a_summary_by_hand():
    alone = dict(BASE, recording="e", way="ratio")  # nothing to compare with
    found = [
        *recorded("a", "hopper", 10, 20, -30),
        *recorded("b", "hopper", 5, np.nan),
        *recorded("c", "walker2d", -1, -1, 8),
        *recorded("d", "walker2d", 7, -7),
        alone,
    ]
    before, uniform, model, starts, both = summary(found)
    assert (before["hopper"], uniform["hopper"]) == (90, 110)
    assert (model["hopper"], model["walker2d"]) == (-50, -50)
    assert (model["better in trials"], model["n"]) == (0, 10)
    assert (model["better on"], model["recordings"], model["p"]) == (0, 4, 0.125)
    assert (starts["better on"], starts["recordings"], starts["p"]) == (0, 0, 1)  # all are ties
    assert (both["hopper"], both["walker2d"]) == (7.5, -1)
    assert (both["better in trials"], both["n"]) == (5, 9)
    # On a and b better in most trials, on c worse, on d in as many; four equal signs in 8 cases.
    assert (both["better on"], both["recordings"], both["p"]) == (2, 3, 1)
    assert "diverged in 1 trials" in in_sentences(found)[1]


def copied(run: RunReader, to: Path) -> list[Path]:
    """A copy of the run in folder `to`; the files of its policies."""
    to.parent.mkdir(exist_ok=True)
    shutil.copytree(run.path, to)
    return sorted((to / "policies").iterdir())


def test_runs_without_critics_are_left_out_and_refused_by_name(
    run: RunReader, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    store = tmp_path / "store"
    for path in copied(run, store / "older"):
        kept = {n: a for n, a in read_arrays(path).items() if not n.startswith("critic_")}
        np.savez(path, allow_pickle=False, **kept)
    words = ["reproduce", "improvement", "--store", str(store), "--out", str(tmp_path / "o")]
    words += ["--model", "linear", "--updates", "5", "--episodes", "1", "--moments", "1"]
    words += ["--jobs", "1", "--ways", "uniform", "--json"]
    assert main(words) == 2
    assert "run older kept no critics" in capsys.readouterr().err
    copied(run, store / "newer")
    assert main([*words, "newer", "older"]) == 2
    capsys.readouterr()
    assert main(words) == 0
    assert "of 1 runs" in json.loads(capsys.readouterr().out)["verdict"][0]
