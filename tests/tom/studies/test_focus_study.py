"""Every learner's model on the same buffer, tested on what the policy makes anew."""

from pathlib import Path

import numpy as np
import pytest

from tom.analysis.ordered_data import load_run
from tom.cli import main
from tom.config import SacRecordingConfig, TomConfig
from tom.data.transitions import Transitions
from tom.envs import task
from tom.policy.stored import NAME, read_policy
from tom.record import RunReader, Store
from tom.studies.focus import (
    RIVALS,
    Case,
    _collect_test_rows,
    _config,
    focus,
    summary,
)
from tom.training.run import train


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> RunReader:
    config = SacRecordingConfig(env="hopper").but(
        steps=1000,
        exploration_steps=500,
        sac={"hidden": 16, "batch_size": 32},
        evaluation={"every": 1000, "episodes": 1},
    )
    return train(config, Store(tmp_path_factory.mktemp("store")), "recorded", rerun=False)


MLE = {"recording": "hopper-s0", "rival": "mle", "seed": 0, "ess": 1.0}
MLE |= {"policy": 0.2, "policy_rollout": 0.8, "ordered": 0.2, "random": 0.1}


def test_a_summary_by_hand():
    rows = [
        MLE,
        dict(MLE, rival="tom paper", ess=0.1, policy=0.1, random=0.3),
        dict(MLE, seed=1, policy=0.4),
        dict(MLE, rival="tom paper", seed=1, ess=0.2, policy=0.3, random=0.2),
    ]
    mle, tom = summary(rows)
    assert mle["policy"] == pytest.approx(0.3)
    assert mle["policy / mle"] == mle["random / mle"] == 1
    assert tom["policy"] == pytest.approx(0.2)
    assert tom["policy / mle"] == pytest.approx((0.5 + 0.75) / 2)  # seed by seed
    assert tom["random / mle"] == pytest.approx(2.5)
    assert tom["ess"] == pytest.approx(0.15)


def test_models_are_tested_on_what_no_learner_has_seen(recording: RunReader):
    data, policy = load_run(recording), read_policy(recording.path / NAME)
    tested = _collect_test_rows(data, policy, task("hopper"), 0)
    seen = {tuple(row) for row in data.transitions.obs.tolist()}
    assert not seen & {tuple(row) for row in tested["policy"].obs.tolist()}
    halves = data.transitions[: data.ordered_from], data.transitions[data.ordered_from :]
    for rows, half in zip((tested["random"], tested["ordered"]), halves, strict=True):
        assert _obs(rows.numpy()) <= _obs(half.numpy())


def test_all_weight_on_new_rows_costs_the_random_half(recording: RunReader):
    mle = focus(Case(recording.path, "mle", 0, preset="smoke"))
    pmac = focus(Case(recording.path, "pmac", 0, preset="smoke"))
    assert (mle["rival"], pmac["rival"]) == ("mle", "pmac")
    assert mle["ess"] == pytest.approx(1.0)
    assert pmac["ess"] < 0.6
    assert pmac["random"] > mle["random"]


def test_toms_rivals_have_the_objectives_of_their_presets():
    paper, mended, exact = (
        _config("hopper", rival, "paper").tom for rival in RIVALS if rival.startswith("tom ")
    )
    assert paper == TomConfig.preset("paper")
    assert (mended.flow, mended.q_holdout, mended.divergence) == ("stationary", 0.2, "kl")
    assert exact == TomConfig.preset("exact")
    assert _config("hopper", "tom mended", "smoke").tom == mended  # a small model alone


def test_a_recording_that_is_missing_is_named_by_its_command(recording: RunReader, capsys):
    store = str(recording.path.parent)  # its only recording has other settings
    assert main(["reproduce", "focus", "--env", "hopper", "--steps", "1000", "--store", store]) == 2
    assert "tom record-sac --env hopper --steps 1000 --seed 0" in capsys.readouterr().err


@pytest.mark.slow
def test_the_command_writes_what_it_prints(tmp_path: Path, capsys):
    env, store, out = "inverted-pendulum", tmp_path / "store", tmp_path / "out"
    train(SacRecordingConfig(env=env, steps=1000), Store(store), rerun=False)
    arguments = ["reproduce", "focus", "--env", env, "--steps", "1000", "--seeds", "0"]
    assert main([*arguments, "--store", str(store), "--out", str(out)]) == 0
    assert {p.name for p in out.iterdir()} == {
        "errors.csv", "summary.csv", "errors.png", "errors.svg", "report.html", "report.json",
        "cases",
    }  # fmt: skip
    assert "tom exact" in capsys.readouterr().out


def _obs(rows: Transitions) -> set[tuple[float, ...]]:
    return {tuple(row) for row in np.asarray(rows.obs).tolist()}
