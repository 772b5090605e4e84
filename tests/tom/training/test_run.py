"""A run stopped, or killed, and resumed leaves the folder of a run that was never interrupted."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from common import online, stopping_at
from same_records import assert_same_record

from tom.config import OnlineConfig
from tom.errors import UserError
from tom.record import RunReader, Store
from tom.training.resume import resume
from tom.training.run import train

STEPS, STOP = 420, 333


def config(**changes: object) -> OnlineConfig:
    given = {"steps": STEPS, "tom": {"warmup": 50}, "checkpoint_every": 100, **changes}
    return online("hopper", "tom", given)


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> RunReader:
    store = Store(tmp_path_factory.mktemp("undisturbed"))
    return train(config(), store, "whole", rerun=False)


def test_stopped_and_resumed_is_the_run_that_was_never_interrupted(undisturbed, tmp_path: Path):
    store = Store(tmp_path)
    stop, watchers = stopping_at(STOP)
    stopped = train(config(), store, "a", rerun=False, watchers=watchers, stop=stop)
    assert stopped.status.state == "stopped"
    assert stopped.status.env_step == STOP
    assert "--resume a" in stopped.status.reason
    resumed = resume(store, "a", rerun=False, command="tom train --resume a")
    assert resumed.status.state == "finished"
    assert resumed.config["resumes"][0]["command"] == "tom train --resume a"
    assert_same_record(undisturbed, resumed)


def test_a_finished_run_that_goes_on_has_its_last_fit_examined_anew(undisturbed, tmp_path: Path):
    store = Store(tmp_path)
    early = train(config(steps=STOP), store, "a", rerun=False)

    def exams(run: RunReader) -> dict[int, float]:
        table = run.metrics().dropna(subset="exam/error")
        return dict(zip(table["env_step"], table["exam/error"], strict=True))

    first, whole = exams(early), exams(undisturbed)
    assert list(first) == [200, 300]  # the second over 33 steps so far
    assert list(whole) == [200, 300, 400]
    assert first[200] == whole[200]
    assert first[300] != whole[300]
    with pytest.raises(UserError, match="--steps"):
        resume(store, "a", rerun=False)
    longer = resume(store, "a", steps=STEPS, rerun=False)
    assert exams(longer) == whole
    assert longer.status.total == STEPS
    np.testing.assert_array_equal(longer.buffer()[0].obs, undisturbed.buffer()[0].obs)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_a_gpus_run_is_refused_in_one_line_where_there_is_none(undisturbed, tmp_path: Path):
    shutil.copytree(undisturbed.path, tmp_path / "gpu")
    path = tmp_path / "gpu" / "config.json"
    path.write_text(path.read_text().replace('"device": "cpu"', '"device": "cuda"'))
    with pytest.raises(UserError, match="--device cuda"):
        resume(Store(tmp_path), "gpu", steps=1000, rerun=False)
    with pytest.raises(UserError, match="--device cuda:1"):
        train(config(device="cuda:1"), Store(tmp_path), "new", rerun=False)
    assert not (tmp_path / "new").exists()
