"""Sweeps whose runs lie in an object store."""

import json
import signal
from pathlib import Path

import pytest
from sweeping import assert_same_runs, beyond_a_checkpoint, finish, plan, until

from tom.cli import main
from tom.record import Store
from tom.record.bucket.fetching import FETCHED, fetch_run
from tom.record.bucket.objects import Bucket
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
    try:
        code = main(["sweep", *SMOKE, *words])
    except SystemExit as stop:
        code = stop.code
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
    planned, bucket = plan(learner=["mle"], seeds=1, steps=1500), Bucket.open(bucket_url)
    with BucketBackend(bucket, planned) as backend:
        driver = Driver(backend, planned, LocalEngine(1), back_off_s=0.1)
        (job,) = driver.jobs
        until(lambda: beyond_a_checkpoint(backend.store), driver.poll)
        assert job.process
        job.process.signal(signal.SIGKILL)
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
