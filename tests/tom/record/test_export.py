"""Exports and small copies of a run that was recorded for real, read back as others read them."""

import json
import resource
import shutil
import struct
import subprocess
import sys
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from common import change, present
from recorded import ACTION, FIT, STEPS, Config, episodes, events, transitions
from tensorboardX.proto import event_pb2

from tom.errors import TRY_LATER, UserError
from tom.events import Collected, Evaluation, Field, KeptPolicy, Metrics, Tick, Weights
from tom.record import RunReader, Store, checkpoint, decode, layout, manage
from tom.record.export import export, export_small
from tom.record.files import size_of
from tom.record.integrity import verify
from tom.record.recorder import Recorder
from tom.record.rerun import viewer
from tom.record.rerun.feed import Tail
from tom.record.thin import coarse, half
from tom.record.writer import RunWriter

Event = vars(event_pb2)["Event"]


def tensorboard_scalars(folder: Path) -> list[tuple[str, int, float]]:
    """(name, step, value) of every scalar: records of length, checksum, content, checksum."""
    (file,) = folder.iterdir()
    content, found, at = file.read_bytes(), [], 0
    while at < len(content):
        (length,) = struct.unpack_from("<Q", content, at)
        event = Event.FromString(content[at + 12 : at + 12 + length])
        found += [(v.tag, event.step, v.simple_value) for v in event.summary.value]
        at += 16 + length
    return found


def test_tables(record, tmp_path: Path):
    run = record()
    table = run.metrics()
    csv = pd.read_csv(export(run, "csv", tmp_path))
    pd.testing.assert_frame_equal(csv, table, rtol=1e-12)
    pd.testing.assert_frame_equal(pd.read_parquet(export(run, "parquet", tmp_path)), table)


def test_json_holds_everything_but_arrays(store: Store, record, tmp_path: Path):
    run = record()
    manage.label(store, "run", note="kept")
    content = json.loads(export(run, "json", tmp_path).read_text())
    assert content["description"] == run.config
    assert content["labels"]["note"] == "kept"
    assert [row["env_step"] for row in content["metrics"]] == list(range(100, STEPS + 1, 100))
    assert np.array(content["profiles"]["bins"]).shape == run.profiles().bins.shape
    assert content["notices"] == run.notices()


def test_tensorboard_events_hold_every_number(record, tmp_path: Path):
    run = record()
    scalars = tensorboard_scalars(export(run, "tensorboard", tmp_path))
    table = run.metrics().set_index("env_step")
    assert len(scalars) == int(table.notna().sum().sum())
    for name, step, value in scalars:
        assert value == pytest.approx(table.loc[step, name], rel=1e-6)


def _export_within(run: RunReader, kind: str, folder: Path, size: int) -> None:
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))
    with pytest.raises(OSError):  # noqa: PT011 - of any kind
        export(run, kind, folder)


@pytest.mark.fault
@pytest.mark.parametrize(("kind", "share"), [("csv", 0.5), ("tensorboard", 0.5), ("rrd", 0.99)])
def test_a_disk_that_is_full_during_an_export__is_named_and_nothing_is_left(
    record, tmp_path: Path, kind: str, share: float
):
    run = record()
    whole = export(run, kind, tmp_path)
    size = int(share * (whole.stat().st_size if whole.is_file() else size_of(whole)))
    out = tmp_path / "out"
    # In a process of its own: Rerun's threads survive no fork, and one may hang.
    child = get_context("spawn").Process(target=_export_within, args=(run, kind, out, size))
    child.start()
    child.join(60)
    alive = child.is_alive()
    child.kill()
    child.join()
    assert not alive
    assert child.exitcode == 0
    assert list(out.iterdir()) == []


def test_a_full_disk_asks_to_try_later(record, tmp_path: Path) -> None:
    run = record()
    words = ["-m", "tom", "runs", "export", run.run_id, "--store", str(run.path.parent)]
    done = subprocess.run(
        [sys.executable, *words, "--format", "json", "--out", str(tmp_path / "out")],
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (500, 500)),
        check=False,
    )
    assert done.returncode == TRY_LATER
    assert not [*(tmp_path / "out").glob("*")]


def test_a_recording_is_made_from_the_files(record, tmp_path: Path):
    run = record()
    assert run.rrd_files() == []
    path = export(run, "rrd", tmp_path)
    assert path.read_bytes()[:4] == b"RRF2"
    verify = [viewer.binary(), "rrd", "verify", path]  # it also misses an end that was cut off
    subprocess.run(verify, env=viewer.without_analytics(tmp_path), check=True, capture_output=True)


def test_a_small_copy_reads_like_the_run(store: Store, record, tmp_path: Path):
    run = record()
    manage.label(store, "run", name="shown")
    small = RunReader(export_small(run, tmp_path))
    assert small.is_run
    assert small.problems == []
    assert small.labels.name == "shown"
    assert small.status == run.status
    assert small.config["config"] == run.config["config"]
    known = run.metrics().dropna(axis=1, how="all")
    pd.testing.assert_frame_equal(small.metrics(), known, rtol=1e-4)
    np.testing.assert_allclose(small.profiles().bins, run.profiles().bins, rtol=1e-4)
    followed = [row["env_step"] for row in Tail(small.path / "metrics.jsonl").rows()]
    assert followed == small.metrics()["env_step"].tolist()
    steps = small.snapshot_steps()
    assert steps[-1] == run.snapshot_steps()[-1]
    np.testing.assert_allclose(
        small.snapshot(steps[-1])["weight"], run.snapshot(steps[-1])["weight"], rtol=1e-3
    )
    for name in ("obs", "action", "reward", "next_obs", "terminated"):
        kept, whole = (getattr(one.buffer()[0], name) for one in (small, run))
        np.testing.assert_allclose(kept, whole, rtol=1e-3)
    np.testing.assert_array_equal(small.buffer()[1], run.buffer()[1])
    (episode,) = small.episodes(STEPS)
    np.testing.assert_allclose(episode.obs, run.episodes(STEPS)[0].obs, rtol=1e-3)
    assert episode.info == run.episodes(STEPS)[0].info


def test_coarse_numbers_are_close_and_special_ones_stay():
    numbers = np.random.default_rng(0).normal(size=1000) * 10.0 ** np.arange(-10, 10).repeat(50)
    np.testing.assert_allclose(coarse(numbers), numbers, rtol=2**-11)
    special = np.array([0.0, -0.0, np.inf, -np.inf, np.nan, 1.0])
    np.testing.assert_array_equal(coarse(special), special.astype(np.float32))
    assert coarse(np.array([True])).dtype == bool
    assert coarse(np.array(1.5)).shape == ()


def test_an_export_is_never_written_over(record, tmp_path: Path):
    run = record()
    for write in (lambda: export(run, "csv", tmp_path), lambda: export_small(run, tmp_path)):
        write()
        before = sorted(tmp_path.iterdir())
        with pytest.raises(UserError, match="exists already"):
            write()
        assert sorted(tmp_path.iterdir()) == before


# Small copies: what they keep is the run's, what they leave out they name


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


def test_weights_of_fewer_rows_than_steps_keep_their_place(record, tmp_path: Path):
    """A loop of several environments has steps whose episodes are not recorded yet."""
    run = record(given=[Weights(400, np.ones(200, np.float32), rows=240)])
    small = RunReader(export_small(run, tmp_path))
    assert small.profiles().rows_at(400) == run.profiles().rows_at(400) == 240


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
    (run.path / layout.LIVE / "tom").mkdir(parents=True)
    shutil.copy(run.path / layout.CONFIG, run.path / layout.LIVE / "tom")
    small = RunReader(export_small(run, tmp_path))
    lacking = {
        "checkpoint", "live weights", "recording", "simulator states", "other snapshots",
        "other evaluations", "per-dimension weights", "other pictures", "other policies",
    }  # fmt: skip
    assert small.policy_steps() == small.snapshot_steps()
    assert set(small.left_out) == lacking
    again = RunReader(export_small(small, tmp_path / "again"))
    assert again.left_out == small.left_out
    few = RunReader(export_small(run, tmp_path / "few", without=["snapshots", "evaluations"]))
    assert (few.snapshot_steps(), few.evaluation_steps()) == ([], [])
    assert {"snapshots", "evaluations"} <= {*few.left_out}
    assert verify(few) == []


def test_policies_are_kept_of_a_run_that_weighs_nothing(record, tmp_path: Path):
    """As a recording of SAC, which `tom reproduce footprint` weighs at the policies it kept."""
    policy = {"weight_0": np.full(9, 1 / 3, np.float32)}
    run = record(given=[KeptPolicy(100 * n, policy) for n in range(1, 6)])
    small = RunReader(export_small(run, tmp_path))
    assert small.policy_steps() == [100, 200, 300, 400, 500]
    assert small.left_out == ()
    kept = present(small.arrays(layout.policy(300)))
    assert kept["weight_0"].dtype == np.float16
    assert kept["weight_0"][0] == np.float16(1 / 3)


def test_a_copy_does_not_tell_where_its_run_lay(record, tmp_path: Path):
    run = record()
    change(
        run.path / "config.json",
        command="tom train --env hopper --store '/home/me/my runs' --seed=3 --out=/home/me/out",
        resumes=[{"at": "noon", "command": "tom train --resume=run --store=/home/me --headless"}],
    )
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
