import threading
from dataclasses import replace

import numpy as np
import pytest
from common import recorded
from kernel import wait_for
from recorded import (
    ACTION,
    EVALUATE,
    FIT,
    STEPS,
    Config,
    episodes,
    events,
    transitions,
    weights,
)

from tom.events import Collected, Metrics, Tick, Weights
from tom.record import Store
from tom.record import recorder as recorder_module
from tom.record.recorder import Recorder
from tom.record.writer import RunWriter

EVERY_FIT = list(range(FIT, STEPS + 1, FIT))
POLICY = {"weight_0": np.ones((2, 3), np.float32)}


def test_metrics_are_one_row_a_step(record):
    table = record().metrics()
    assert table["env_step"].tolist() == EVERY_FIT
    np.testing.assert_allclose(table["model/holdout_nll"], -np.array(EVERY_FIT) / 10)
    assert table["critic/q"].isna().all()
    assert (np.diff(table["time/wall_s"]) >= 0).all()
    assert (table["time/record_s"] >= 0).all()


@pytest.mark.parametrize("resumed", [False, True])
def test_a_step_told_in_two_rows_has_the_time_of_the_first(store: Store, resumed: bool):
    now = [0.0]
    recorder = Recorder(RunWriter.create(store, "run", Config), timer=lambda: now[0])
    for name, at in (("eval/return", 100.0), ("model/rounds", 112.0)):
        now[0] = at
        recorder.consume(Metrics(9000, {name: 1.0}))
        recorder.consume(Tick(9000, "fit"))
        if resumed:
            mark = recorder.mark()
            recorder.finish("stopped")
            writer = RunWriter(store.path / "run", Config)
            recorder = Recorder(writer, timer=lambda: now[0], mark=mark)
    recorder.finish("finished")
    (row,) = store.run("run").metrics().to_dict("records")
    assert (row["eval/return"], row["model/rounds"], row["time/wall_s"]) == (1, 1, 100)


def test_what_is_told_of_an_earlier_step_is_in_its_row_and_changes_no_time(store: Store):
    now = [0.0]
    writer = RunWriter.create(store, "run", Config)
    with Recorder(writer, timer=lambda: now[0]) as recorder:
        for step in range(1, 301):
            now[0] += 1.0
            if step % 100 == 0:
                recorder.consume(Tick(step, "fit"))
                if step > 100:
                    recorder.consume(Metrics(step - 100, {"exam/error": step / 100}))
                recorder.consume(Metrics(step, {"model/rounds": float(step)}))
            recorder.consume(Tick(step, "optimise"))
        assert recorder.status.env_step == 300
    run = store.run("run")
    (run.path / "metrics.parquet").replace(run.path / "copy")
    table = run.metrics().set_index("env_step")
    assert table.index.tolist() == [100, 200, 300]
    assert table["model/rounds"].tolist() == [100, 200, 300]
    assert table["exam/error"].dropna().tolist() == [2, 3]
    assert table["time/wall_s"].tolist() == [100, 200, 300]
    assert table["time/env_steps_per_s"].dropna().tolist() == [1, 1, 1]
    (run.path / "copy").replace(run.path / "metrics.parquet")
    assert run.metrics().set_index("env_step").equals(table)


def test_evaluations_become_metrics_with_a_running_maximum(record):
    table = record().metrics().set_index("env_step").loc[[EVALUATE, STEPS]]
    # Episodes of 4 and 6 steps with a reward of 500, later of -1000, each step.
    assert table["eval/return"].tolist() == [2500, -5000]
    assert table["eval/return_max"].tolist() == [2500, 2500]
    assert table["eval/return_std"].tolist() == [500, 1000]
    assert table["eval/length"].tolist() == [5, 5]
    assert table["eval/success"].tolist() == [0.5, 0.5]


def test_a_profile_for_every_fit(record):
    profiles = record().profiles()
    assert profiles.env_step.tolist() == EVERY_FIT
    assert profiles.count.tolist() == EVERY_FIT
    assert profiles.bins.shape == (10, 100)
    np.testing.assert_allclose(profiles.bins[1], np.arange(100) * 2 + 1.5)
    n = np.array(EVERY_FIT)
    np.testing.assert_allclose(profiles.ess, 1.5 * (n + 1) / (2 * n + 1))
    assert not profiles.zeros.any()


def test_snapshots_are_spread_over_the_run_and_the_last_is_there(record):
    run = record()
    assert run.snapshot_steps() == [100, 400, 700, 1000]
    table = run.snapshot(400)
    np.testing.assert_array_equal(table["weight"], np.arange(400) + 1)
    np.testing.assert_array_equal(table["log_ratio"], -np.arange(400))


def test_a_part_of_the_run_has_one_snapshot_also_where_a_fit_falls_on_its_first_step(store: Store):
    config = Config.but(steps=40_000, snapshots=12)
    fits = [Weights(step, np.ones(1, np.float32)) for step in range(5000, 40_000, 250)]
    run = recorded(store, "run", config, fits)
    kept = [5000, 6750, 10000, 13500, 16750, 20000, 23500, 26750, 30000, 33500, 36750, 39750]
    assert run.snapshot_steps() == kept


def test_a_run_without_chosen_snapshots_keeps_the_last(store: Store):
    config = Config.but(snapshots=0)
    fits = [replace(weights(step), policy=POLICY) for step in EVERY_FIT]
    run = recorded(store, "run", config, fits)
    assert run.snapshot_steps() == run.policy_steps() == [1000]


def test_weights_of_each_dimension_are_kept(record):
    per_dim = np.arange(20, dtype=np.float32).reshape(10, 2)
    table = record(given=[Weights(100, per_dim.mean(1), per_dim=per_dim)]).snapshot(100)
    np.testing.assert_array_equal(table[["dim_0", "dim_1"]], per_dim)


def test_episodes_come_back_whole(record):
    run = record()
    assert run.evaluation_steps() == [EVALUATE, STEPS]
    for got, want in zip(run.episodes(EVALUATE), episodes(EVALUATE), strict=True):
        for name in ("reward", "action", "obs", "qpos", "qvel"):
            np.testing.assert_array_equal(getattr(got, name), getattr(want, name))
        assert (got.terminated, got.truncated) == (want.terminated, want.truncated)
        assert got.info == want.info


def test_the_buffer_comes_back_in_order_with_its_policies(record):
    rows, version = record().buffer()
    want = transitions(0, STEPS)
    for name in ("obs", "action", "reward", "next_obs", "terminated", "truncated"):
        np.testing.assert_array_equal(getattr(rows, name), getattr(want, name))
    assert rows.action.shape == (STEPS, ACTION)
    np.testing.assert_array_equal(version, np.arange(STEPS) // FIT + 1)


def test_a_large_buffer_is_few_files(store: Store):
    writer = RunWriter.create(store, "run", Config)
    for first in range(0, 10_000, 250):
        writer.rows(Collected(0, transitions(first, 250), np.full(250, first)))
    writer.close()
    run = store.run("run")
    assert len(list((run.path / "buffer").iterdir())) == 3
    np.testing.assert_array_equal(run.buffer()[0].reward, np.arange(10_000))


def test_going_back_to_a_mark_leaves_nothing_of_what_came_after(store: Store):
    recorder = Recorder(RunWriter.create(store, "run", Config))
    given = events()
    for event in given:
        if event == Tick(350, "optimise"):
            break
        recorder.consume(event)
    mark = recorder.mark()
    recorder.consume(
        Collected(400, transitions(300, 5000), np.zeros(5000, int))
    )  # ends the segment
    recorder.consume(Collected(400, transitions(5300, 50), np.zeros(50, int)))
    recorder.consume(Metrics(400, {"lost": 1.0}))
    recorder.finish("failed", "killed")
    again = Recorder(RunWriter(store.path / "run", Config), mark=mark)
    for event in given[given.index(Tick(350, "optimise")) :]:
        again.consume(event)
    again.finish("finished")
    run = store.run("run")
    assert run.metrics()["env_step"].tolist() == EVERY_FIT
    assert "lost" not in run.metrics()
    assert run.profiles().env_step.tolist() == EVERY_FIT
    np.testing.assert_array_equal(run.buffer()[0].reward, np.arange(STEPS))
    assert run.problems == []


def test_speed_and_time_left_follow_the_clock(store: Store):
    now = [1000.0]
    writer = RunWriter.create(store, "run", Config)
    recorder = Recorder(writer, clock=lambda: now[0], timer=lambda: now[0])
    recorder.consume(Tick(300, "explore"))
    now[0] += 1
    recorder.consume(Tick(301, "optimise"))  # the exploration's speed is forgotten here
    now[0] += 20
    recorder.consume(Tick(401, "optimise"))
    recorder.beat()
    status = store.run("run").status
    assert (status.phase, status.env_step, status.heartbeat) == ("optimise", 401, 1021.0)
    assert status.env_steps_per_s == 5.0
    assert status.eta_s == (STEPS - 401) / 5
    recorder.finish("finished")


def test_the_heart_beats_while_training_is_busy(store: Store, monkeypatch):
    monkeypatch.setattr(recorder_module, "BEAT_S", 0.01)
    recorder = Recorder(RunWriter.create(store, "run", Config))
    first = store.run("run").status
    assert first.alive
    wait_for(lambda: store.run("run").status.heartbeat != first.heartbeat)
    recorder.finish("finished")
    assert "heartbeat" not in [thread.name for thread in threading.enumerate()]
