"""Sweeps whose runs lie in an object store."""

import json
import signal
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from commands import refused
from common import change, recorded
from sweeping import assert_same_runs, beyond_a_checkpoint, finish, plan, until

from tom.cli import main
from tom.errors import TRY_LATER
from tom.events import Tick
from tom.record import RunReader, Store, layout
from tom.record.bucket import CLAIM, FETCHED, Attempt, Bucket, fetch_run, newest
from tom.sweep import bucket as worker
from tom.sweep.bucket import LEASE_S, LOOK_S, BucketBackend
from tom.sweep.driver import Driver, FolderBackend
from tom.sweep.engine import LocalEngine
from tom.training.plan import Trial

pytestmark = pytest.mark.slow
OWN = "0123abcd"  # the end of an attempt's name
SMOKE = ("--env", "inverted-pendulum", "--learner", "mle", "--preset", "smoke", "--steps", "60")


def test_a_sweep_into_an_object_store_and_its_runs_out_of_it(
    bucket_url: str, tmp_path: Path, capsys
):
    words = ["sweep", *SMOKE, "--store", bucket_url]
    assert main([*words, "--json"]) == 0
    said = capsys.readouterr()
    (row,) = json.loads(said.out)
    assert (row["state"], row["env_step"]) == ("finished", 60)
    assert f"tom runs fetch {bucket_url} --store runs" in said.err
    assert main([*words, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)[0]["note"] == "was there already"
    assert main(["runs", "fetch", bucket_url, "--store", str(tmp_path)]) == 0
    run = Store(tmp_path).run(row["run_id"])
    assert (run.status.state, len(run.buffer()[0]), run.problems) == ("finished", 60, [])


@pytest.mark.quick
@pytest.mark.usefixtures("bucket_url")
def test_bad_places_are_refused_in_one_line(tmp_path: Path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for words, named in {
        ("sweep", *SMOKE, "--store", "s3://nowhere/x"): "there is no bucket 'nowhere'",
        ("sweep", *SMOKE, "--store", "gs://store/x"): "s3://BUCKET/PREFIX",
        ("sweep", *SMOKE, "--store", "s3://store/x", "--engine", "slurm"): "needs a folder",
        ("train", *SMOKE, "--store", "s3://store/x"): "tom runs fetch",
        ("runs", "fetch", "s3://store/empty"): "no runs in s3://store/empty",
    }.items():
        refused(words, capsys, named)
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:9")
    refused(["runs", "fetch", "s3://store/x"], capsys, "cannot reach the bucket")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.fault
def test_a_worker_killed_with_all_it_had__goes_on_from_the_object_store_to_the_same_numbers(
    bucket_url: str, tmp_path: Path, monkeypatch
):
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr("tom.sweep.bucket.LOOK_S", 0.1)  # to see it while it runs
    planned, bucket = plan(learner=["mle"], seeds=[0], steps=16_000), Bucket.open(bucket_url)
    backend = BucketBackend(bucket, Store(tmp_path / "seen"), [planned[0].run_id])
    driver = Driver(backend, planned, LocalEngine(1), back_off_s=0.1)
    (job,) = driver.jobs
    until(lambda: beyond_a_checkpoint(backend.store), driver.poll)
    assert job.process
    job.process.kill()
    (tmp_path / "another machine").mkdir()
    monkeypatch.setenv("TMPDIR", str(tmp_path / "another machine"))
    finish(driver)
    assert job.state == "finished", job.note
    fetched, undisturbed = Store(tmp_path / "fetched"), Store(tmp_path / "undisturbed")
    assert fetch_run(bucket, job.run_id, fetched) == FETCHED
    assert fetched.run(job.run_id).config["resumes"]
    finish(Driver(FolderBackend(undisturbed), planned, LocalEngine(1)))
    assert_same_runs(fetched, undisturbed)


def test_a_store_that_does_not_answer_a_worker_is_no_reason_to_give_up_at_once(
    bucket_url: str, tmp_path: Path, monkeypatch
):
    planned = plan(learner=["mle"], seeds=[0])
    backend = BucketBackend(Bucket.open(bucket_url), Store(tmp_path / "seen"), [planned[0].run_id])
    driver = Driver(backend, planned, LocalEngine(1), back_off_s=1e6)
    with monkeypatch.context() as away:
        away.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:9")
        driver.poll()
    (job,) = driver.jobs
    until(lambda: job.process is None, driver.poll)
    assert (job.state, job.attempts) == ("waiting", 1)
    assert "cannot reach the bucket" in job.note


@pytest.fixture
def trial() -> Trial:
    (one,) = plan(learner=["mle"], seeds=[0])
    return one


class Elsewhere:
    """Another machine's worker of a run, whose clock is off."""

    def __init__(self, bucket: Bucket, trial: Trial, folder: Path) -> None:
        ticked = [Tick(10, "explore")]
        one = recorded(Store(folder), trial.run_id, trial.config, ticked, state="stopped")
        self.folder = one.path
        self.attempt = Attempt.claim(bucket, trial.run_id)

    def put(self, state: str, heartbeat: float) -> None:
        change(self.folder / layout.STATUS, state=state, heartbeat=heartbeat)
        self.attempt.put(self.folder)


@pytest.mark.quick
def test_all_runs_are_fetched_while_another_has_only_begun(
    bucket_url: str, trial: Trial, tmp_path: Path
):
    bucket = Bucket.open(bucket_url)
    Attempt.claim(bucket, "a-first-one")
    Elsewhere(bucket, trial, tmp_path / "other").put("running", time.time())
    assert main(["runs", "fetch", bucket_url, "--store", str(tmp_path / "here")]) == 0
    assert Store(tmp_path / "here").names() == [trial.run_id]


@pytest.mark.parametrize("off_s", [-1e4, 1e4])
def test_a_run_is_left_to_another_machine_until_it_was_seen_unchanged_for_long(
    off_s: float, bucket_url: str, trial: Trial, tmp_path: Path
):
    bucket, now = Bucket.open(bucket_url), 0.0
    other = Elsewhere(bucket, trial, tmp_path)
    other.put("running", time.time() + off_s)
    backend = BucketBackend(bucket, Store(tmp_path / "seen"), [trial.run_id], lambda: now)
    driver = Driver(backend, [trial], LocalEngine(1))
    (job,) = driver.jobs
    for beat in range(1, 4):
        other.put("running", time.time() + off_s + beat)
        now += LOOK_S
        driver.poll()
        now += LEASE_S - 1.0
        driver.poll()
        assert job.state == "elsewhere"
    now += LOOK_S
    driver.poll()
    assert job.state == "running"
    driver.stop()


@pytest.mark.fault
def test_a_worker_whose_run_another_machine_takes_over__ends_and_is_no_failure(
    bucket_url: str, trial: Trial, tmp_path: Path, monkeypatch
):
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    bucket = Bucket.open(bucket_url)
    backend = BucketBackend(bucket, Store(tmp_path / "seen"), [trial.run_id])
    driver = Driver(backend, [trial], LocalEngine(1))
    (job,) = driver.jobs
    until(lambda: newest(bucket.names(trial.run_id), CLAIM), driver.poll)
    Attempt.claim(bucket, trial.run_id)
    until(lambda: job.process is None, driver.poll)
    assert job.state == "elsewhere"
    assert "was taken over by another attempt" in job.log.read_text()


@pytest.fixture
def worked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The temporary folder of workers in this process; the signals they take are given back."""
    numbers = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)
    before = {number: signal.getsignal(number) for number in numbers}
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setattr(worker, "LAST_PUTS", 1)
    monkeypatch.setattr(worker, "AGAIN_S", 0.0)
    yield tmp_path
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.fault
def test_the_last_puts_fail__the_finished_run_stays_and_the_same_command_puts_it(
    bucket_url: str, worked: Path, monkeypatch, capfd
):
    (trial,) = plan(learner=["mle"], seeds=[0], steps=200)
    words = [*trial.options(), f"--run-id={trial.run_id}", "--resume=auto"]
    put = Attempt.put

    def refused(self: Attempt, folder: Path) -> None:
        if RunReader(folder).status.state != "running":
            raise OSError("the store is gone")
        put(self, folder)

    with monkeypatch.context() as failing:
        failing.setattr(Attempt, "put", refused)
        assert worker.main(bucket_url, OWN, trial.run_id, words) == TRY_LATER
    (kept,) = worked.glob(f"*/*/{trial.run_id}")
    assert RunReader(kept).status.state == "finished"
    assert f"all of it stays in {kept.parent} on this machine" in capfd.readouterr().err
    held = {path.name: path.read_bytes() for path in kept.glob("*.json*")}
    assert worker.main(bucket_url, OWN, trial.run_id, words) == 0
    assert not kept.exists()
    assert fetch_run(Bucket.open(bucket_url), trial.run_id, Store(worked)) == FETCHED
    fetched = worked / trial.run_id
    assert {path.name: path.read_bytes() for path in fetched.glob("*.json*")} == held
    assert len(Bucket.open(bucket_url).folders(trial.run_id)) <= 2, "one is claimed, one is whole"


@pytest.mark.fault
def test_a_run_that_can_never_go_on__begins_anew_and_the_store_keeps_the_old_one(
    bucket_url: str, trial: Trial, worked: Path
):
    bucket = Bucket.open(bucket_url)
    other = Elsewhere(bucket, trial, worked / "other")
    other.put("stopped", time.time())
    words = [*trial.options(), f"--run-id={trial.run_id}", "--resume=auto"]
    assert worker.main(bucket_url, OWN, trial.run_id, words) == 0
    assert bucket.names(f"{trial.run_id}/{other.attempt.name}")
    assert fetch_run(bucket, trial.run_id, Store(worked)) == FETCHED
    assert Store(worked).run(trial.run_id).status.state == "finished"
    assert not list(worked.glob(f"tom-runs-*/*{trial.run_id}"))
