"""Small copies: what they keep is the run's, what they leave out they name."""

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from recorded import ACTION, FIT, STEPS, Config, episodes, events, transitions

from tom.analysis.imagine import stored_model
from tom.errors import UserError
from tom.events import Collected, Evaluation, Field, KeptPolicy, Metrics, Tick, Weights
from tom.record import RunReader, Store, checkpoint, decode, layout
from tom.record.export import export_small
from tom.record.integrity import verify
from tom.record.recorder import Recorder
from tom.record.thin import OPTIONAL, half
from tom.record.writer import RunWriter


def segment(obs: np.ndarray, following: np.ndarray) -> dict[str, np.ndarray]:
    flat = np.zeros(len(obs), np.float32)
    rows = {"obs": obs, "action": obs[:, :1], "reward": flat, "next_obs": following}
    flags = {"terminated": flat > 0, "truncated": flat > 0}
    return rows | flags | {"policy_version": np.zeros(len(obs), np.int64)}


@pytest.mark.parametrize("count", [1, 2, 50])
def test_next_observations_come_back_from_the_following_rows(count: int):
    obs = np.random.default_rng(0).normal(size=(count, 3)).astype(np.float32)
    following = np.concatenate([obs[1:], obs[:1] + 9])
    following[::7] += 1  # an episode ends there
    short = decode.without_next_obs(segment(obs, following))
    assert len(short["jump"]) == len({*range(0, count, 7), count - 1})
    rows, _ = decode.transitions_of(short)
    np.testing.assert_array_equal(rows.next_obs, following)


def test_halves_are_close_and_large_numbers_stay():
    numbers = np.random.default_rng(0).normal(size=1000) * 10.0 ** np.arange(-5, 5).repeat(100)
    assert half(numbers).dtype == (np.float16 if np.abs(numbers).max() < 65504 else np.float32)
    np.testing.assert_allclose(half(numbers / 10), numbers / 10, rtol=2**-11, atol=3e-8)
    assert half(np.array([1e5, np.nan])).tolist()[0] == pytest.approx(1e5, rel=2**-11)
    assert half(np.array([np.inf, 1.0])).dtype == np.float16
    assert half(np.array([True])).dtype == bool


def test_terms_of_weights_are_kept_beside_the_buffer(record, tmp_path: Path):
    rows, row = transitions(0, 9), np.arange(9, dtype=np.float32)
    terms = {"now": row, "following": 2 * row, "restart": 3 * row}
    run = record(
        given=[Collected(1, rows, np.zeros(9, np.int64)), Weights(1, row, None, row, terms)]
    )
    kept = RunReader(export_small(run, tmp_path)).snapshot(1)
    assert list(kept) == ["weight", "log_ratio", "now", "following", "restart"]
    assert kept["restart"].tolist() == (3 * row).tolist()
    alone = RunReader(export_small(run, tmp_path / "alone", without=("buffer",))).snapshot(1)
    assert list(alone) == ["weight", "log_ratio"]


def test_the_fits_that_were_examined_are_kept(store: Store, tmp_path: Path):
    config = Config.but(steps=4000)
    with Recorder(RunWriter.create(store, "run", config)) as recorder:
        for step in range(1, 4001):
            recorder.consume(Metrics(step, {"train/return": float(step)}))
            if step % 40 == 0:
                recorder.consume(Tick(step, "fit"))
                recorder.consume(Metrics(step - 40 or 1, {"exam/error": float(step - 40)}))
            recorder.consume(Tick(step, "optimise"))
    copy = RunReader(export_small(store.run("run"), tmp_path))
    small = copy.metrics()
    assert len(small) < 400
    assert small["exam/error"].dropna().tolist() == [float(step) for step in range(0, 4000, 40)]
    again = RunReader(export_small(copy, tmp_path / "again"))
    pd.testing.assert_frame_equal(again.metrics(), small)  # a copy of a copy loses no row


def test_a_copy_of_a_run_in_training_is_stopped_where_the_copy_ends(store: Store, tmp_path: Path):
    with Recorder(RunWriter.create(store, "run", Config, command="tom train")) as recorder:
        for event in events()[:-1]:
            recorder.consume(event)
        assert store.run("run").status.alive
        small = RunReader(export_small(store.run("run"), tmp_path))
    assert small.shown == "stopped (a small copy)"
    step, rows = small.status.env_step, small.metrics()["env_step"].to_numpy()
    assert step >= rows.max() >= STEPS - FIT
    assert f"step {step}" in small.status.reason
    assert "--resume" not in small.status.reason
    assert (small.status.phase, small.status.eta_s) == ("", None)
    assert RunReader(export_small(small, tmp_path / "again")).status == small.status
    assert verify(small) == []


def test_all_that_a_copy_lacks_is_named_also_in_a_copy_of_it(record, tmp_path: Path):
    rows, version = transitions(0, 9), np.zeros(9, np.int64)
    weight, dims = np.ones(9, np.float32), np.ones((9, 11), np.float32)
    run = record(
        given=[
            Collected(1, rows, version, {"qpos": np.zeros((9, 6)), "qvel": np.zeros((9, 6))}),
            *(Weights(100 * n, weight, dims, policy={"weight_0": weight}) for n in range(10)),
            *(Evaluation(n, episodes(n)[:1]) for n in range(1, 6)),
            *(Field(n, "map", {"gain": weight}) for n in range(6)),
        ]
    )
    checkpoint.save(run.path / checkpoint.FOLDER, 9, {"training": {"coefficients": torch.ones(3)}})
    (run.path / "run.rrd").touch()
    small = RunReader(export_small(run, tmp_path))
    lacking = {
        "checkpoint", "recording", "simulator states", "other snapshots", "other evaluations",
        "per-dimension weights", "other pictures", "other policies",
    }  # fmt: skip
    assert small.policy_steps() == small.snapshot_steps()
    assert set(small.left_out) == lacking
    again = RunReader(export_small(small, tmp_path / "again"))
    assert again.left_out == small.left_out
    few = RunReader(export_small(run, tmp_path / "few", without=["snapshots", "evaluations"]))
    assert (few.snapshot_steps(), few.evaluation_steps()) == ([], [])
    assert {"snapshots", "evaluations"} <= {*few.left_out}
    assert verify(few) == []


def test_a_copy_without_small_parts_says_so_and_reads_well(record, tmp_path: Path):
    rows, weight = transitions(0, 9), np.ones(9, np.float32)
    run = record(
        given=[
            Collected(1, rows, np.zeros(9, np.int64)),
            Weights(100, weight, policy={"weight_0": weight}),
        ]
    )
    checkpoint.save(run.path / checkpoint.FOLDER, 9, {"training": {"coefficients": torch.ones(3)}})
    assert run.left_out == ()
    copy = RunReader(export_small(run, tmp_path / "b", without=[*OPTIONAL]))
    assert copy.left_out == ("buffer", "model", "policies", "checkpoint")
    with pytest.raises(UserError, match="left out of this small copy"):
        stored_model(copy)
    assert (len(copy.buffer()[0]), copy.policy_steps()) == (0, [])
    assert verify(copy) == []
    again = RunReader(export_small(copy, tmp_path / "c", without=[*OPTIONAL]))
    assert again.left_out == copy.left_out


def test_policies_are_kept_of_a_run_that_weighs_nothing(record, tmp_path: Path):
    """As a recording of SAC, which `tom reproduce footprint` weighs at the policies it kept."""
    policy = {"weight_0": np.full(9, 1 / 3, np.float32)}
    run = record(given=[KeptPolicy(100 * n, policy) for n in range(1, 6)])
    small = RunReader(export_small(run, tmp_path))
    assert small.policy_steps() == [100, 200, 300, 400, 500]
    assert small.left_out == ()
    kept = small.arrays(layout.policy(300))
    assert kept is not None
    assert kept["weight_0"].dtype == np.float16
    assert kept["weight_0"][0] == np.float16(1 / 3)


def test_a_copy_does_not_tell_where_its_run_lay(record, tmp_path: Path):
    run = record()
    content = {
        **run.config,
        "command": "tom train --env hopper --store '/home/me/my runs' --seed=3 --out=/home/me/out",
        "resumes": [
            {"at": "noon", "command": "tom train --resume=run --store=/home/me --headless"}
        ],
    }
    (run.path / "config.json").write_text(json.dumps(content))
    small = RunReader(export_small(RunReader(run.path), tmp_path))
    assert small.config["command"] == "tom train --env hopper --seed=3"
    assert small.config["resumes"] == [
        {"at": "noon", "command": "tom train --resume=run --headless"}
    ]


def test_what_is_large_is_left_out_unless_it_is_asked_for(
    record, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr("tom.record.thin.SMALL", 1000)
    run = record()
    without = RunReader(export_small(run, tmp_path / "without"))
    assert "buffer" in without.left_out
    assert len(without.buffer()[0]) == 0
    assert without.problems == []
    kept = RunReader(export_small(run, tmp_path / "kept", keep=("buffer",)))
    assert len(kept.buffer()[0]) == STEPS


def test_the_policy_that_drew_each_action_stays_in_run_and_copy(record, tmp_path: Path):
    rows, width = transitions(0, 9), 2 * ACTION
    behaviour = np.linspace(-3, 3, 9 * width, dtype=np.float32).reshape(9, width)
    behaviour[:2] = np.nan
    run = record(given=[Collected(1, rows, np.arange(9), {}, behaviour)])
    np.testing.assert_array_equal(run.recorded().behaviour, behaviour)
    small = RunReader(export_small(run, tmp_path))
    np.testing.assert_allclose(small.recorded().behaviour, behaviour, rtol=1e-3)
    old = record("old", given=[Collected(1, rows, np.arange(9))])
    assert np.isnan(old.recorded().behaviour).all()
    assert old.recorded().behaviour.shape == (9, width)
