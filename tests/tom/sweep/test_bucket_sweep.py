"""Sweeps whose runs lie in an object store."""

import json
import os
import signal
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from commands import code_of
from sweeping import assert_same_runs, beyond_a_checkpoint, finish, plan, until

from tom.cli import main
from tom.record import RunReader, Store, checkpoint
from tom.record.bucket.attempts import Attempt
from tom.record.bucket.fetching import FETCHED, fetch_run
from tom.record.bucket.objects import Bucket
from tom.sweep import scratch, worker
from tom.sweep.backend import FolderBackend
from tom.sweep.bucket_backend import BucketBackend
from tom.sweep.driver import Driver
from tom.sweep.engine import LocalEngine

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


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (("--store", "s3://nowhere/x"), "there is no bucket 'nowhere'"),
        (("--store", "s3://No_Bucket/x"), "must be s3://BUCKET/PREFIX"),
        (("--store", "gs://store/x"), "s3://BUCKET/PREFIX"),
        (("--store", "s3://store/x", "--engine", "fleet"), "needs a folder"),
        (("--store", "s3://store/x", "--engine", "slurm"), "needs a folder"),
    ],
)
def test_bad_input(words: tuple[str, ...], named: str, bucket_url: str, capsys):
    code = code_of(["sweep", *SMOKE, *words])
    said = capsys.readouterr()
    assert code == 2
    assert named in said.err
    assert said.err.count("\n") == 1
    assert said.out == ""


@pytest.mark.fault
def test_a_worker_killed_with_all_it_had__goes_on_from_the_object_store_to_the_same_numbers(
    bucket_url: str, tmp_path: Path, monkeypatch
):
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    planned, bucket = plan(learner=["mle"], seeds=1, steps=4000), Bucket.open(bucket_url)
    with BucketBackend(bucket, planned) as backend:
        driver = Driver(backend, planned, LocalEngine(1), back_off_s=0.1)
        (job,) = driver.jobs
        until(lambda: beyond_a_checkpoint(backend.store), driver.poll)
        assert job.process
        job.process.signal(signal.SIGKILL)
        (tmp_path / "another machine").mkdir()
        monkeypatch.setenv("TMPDIR", str(tmp_path / "another machine"))
        finish(driver)
        assert job.state == "finished", job.note
        assert f"{job.run_id} --resume={job.run_id}\n" in job.log.read_text()
    fetched, undisturbed = Store(tmp_path / "fetched"), Store(tmp_path / "undisturbed")
    fetched.ensure_writable()
    assert fetch_run(bucket, job.run_id, fetched) == FETCHED
    finish(Driver(FolderBackend(undisturbed), planned, LocalEngine(1)))
    assert_same_runs(fetched, undisturbed)


def test_a_store_that_does_not_answer_a_worker_is_no_reason_to_give_up_at_once(
    bucket_url: str, tmp_path: Path, monkeypatch
):
    planned = plan(learner=["mle"], seeds=1)
    with BucketBackend(Bucket.open(bucket_url), planned) as backend:
        driver = Driver(backend, planned, LocalEngine(1), back_off_s=1e6)
        with monkeypatch.context() as away:
            away.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:9")
            driver.poll()
        (job,) = driver.jobs
        until(lambda: job.process is None, driver.poll)
        assert (job.state, job.attempts) == ("waiting", 1)
        assert "cannot reach the bucket" in job.note


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


def refusing(ended: bool):
    """A put that fails; with `ended` only once the run has ended."""
    put = Attempt.put

    def refused(self: Attempt, folder: Path) -> None:
        if not ended or RunReader(folder).status.state != "running":
            raise OSError("the store is gone")
        put(self, folder)

    return refused


@pytest.mark.fault
@pytest.mark.quick
@pytest.mark.parametrize("from_the_beginning", [False, True])
def test_the_last_puts_fail__the_finished_run_stays_and_the_same_command_puts_it(
    bucket_url: str, worked: Path, monkeypatch, capfd, from_the_beginning: bool
):
    (trial,) = plan(learner=["mle"], seeds=1, steps=200)
    words = [*trial.options(), f"--run-id={trial.run_id}"]
    with monkeypatch.context() as failing:
        failing.setattr(Attempt, "put", refusing(ended=not from_the_beginning))
        assert worker.main(bucket_url, trial.run_id, words) == 1
    (kept,) = worked.glob(f"*/*/{trial.run_id}")
    assert RunReader(kept).status.state == "finished"
    assert f"all of it stays in {kept} on this machine" in capfd.readouterr().err
    held = {path.name: path.read_bytes() for path in kept.glob("*.json*")}
    assert worker.main(bucket_url, trial.run_id, words) == 0
    assert not kept.exists()
    assert fetch_run(Bucket.open(bucket_url), trial.run_id, Store(worked)) == FETCHED
    fetched = worked / trial.run_id
    assert {path.name: path.read_bytes() for path in fetched.glob("*.json*")} == held
    assert len(Bucket.open(bucket_url).folders(trial.run_id)) <= 2, "one is claimed, one is whole"


@pytest.mark.fault
@pytest.mark.quick
def test_the_last_puts_of_a_stopped_run_fail__it_goes_on_from_what_stayed(
    bucket_url: str, worked: Path, monkeypatch
):
    (trial,) = plan(learner=["mle"], seeds=1, steps=200)
    words = [*trial.options(), f"--run-id={trial.run_id}"]
    with monkeypatch.context() as failing:
        failing.setattr(Attempt, "put", refusing(ended=False))
        assert worker.main(bucket_url, trial.run_id, words) == 1
    (kept,) = worked.glob(f"*/*/{trial.run_id}")
    content = json.loads((kept / "status.json").read_text()) | {"state": "stopped"}
    (kept / "status.json").write_text(json.dumps(content))
    assert checkpoint.newest(kept / checkpoint.FOLDER) == 200
    (kept / "checkpoint" / "000000200").rename(kept / "gone")  # as if it had been stopped before
    assert worker.main(bucket_url, trial.run_id, words) == 0
    fetch_run(Bucket.open(bucket_url), trial.run_id, Store(worked))
    done = Store(worked).run(trial.run_id)
    assert done.status.state == "finished"
    assert "--resume" in done.config["resumes"][0]["command"]


@pytest.mark.fault
@pytest.mark.quick
def test_a_second_worker_of_a_run_on_one_machine__takes_another_folder(worked: Path):
    with scratch.place("s3://store/x", "a") as first, scratch.place("s3://store/x", "a") as second:
        assert first != second
    with scratch.place("s3://store/x", "a") as again:
        assert again == first
        (again / "a").mkdir()
    assert again.is_dir()
    assert not second.exists()


@pytest.mark.fault
@pytest.mark.quick
def test_a_temporary_folder_that_others_may_write__is_not_trusted_with_runs(worked: Path):
    (worked / f"tom-runs-{os.getuid()}").mkdir()
    (worked / f"tom-runs-{os.getuid()}").chmod(0o777)
    with scratch.place("s3://store/x", "a") as place:
        assert f"tom-runs-{os.getuid()}" not in place.parts
