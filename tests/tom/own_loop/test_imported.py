"""What other trackers recorded: the numbers of their files are the run's."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from commands import code_of, refused
from loops import loaded
from tensorboardX import SummaryWriter


def test_event_files_of_tensorboard_are_a_run(tmp_path: Path):
    with SummaryWriter(str(tmp_path / "logs")) as writer:
        for step in range(0, 1000, 100):
            writer.add_scalar("charts/episodic_return", step / 10, step)
            writer.add_scalar("losses/critic", 1 / (step + 1), step)
        writer.add_text("hyperparameters", "no number", 0)
    words = ["runs", "import", str(tmp_path / "logs"), "--env", "Hopper-v5", "--store"]
    assert code_of([*words, str(tmp_path / "runs"), "--name", "peer"]) == 0
    run = loaded(tmp_path / "runs", "peer")
    assert run.reader.env == "hopper"
    assert run.metrics["eval/return"].to_dict() == {s: s / 10 for s in range(0, 1000, 100)}
    np.testing.assert_allclose(run.metrics["losses/critic"], 1 / (np.arange(0, 1000, 100) + 1))
    assert "time/wall_s" not in run.metrics
    assert run.summary[["state", "env_step", "last_return"]].tolist() == ["finished", 900, 90]
    [file] = (tmp_path / "logs").glob("*tfevents*")
    file.write_bytes(file.read_bytes()[:-7])  # its training was killed
    assert code_of([*words, str(tmp_path / "runs"), "--name", "killed"]) == 0
    assert len(loaded(tmp_path / "runs", "killed").metrics) == 10


def test_a_run_of_the_folder_that_one_is_in_has_its_name(tmp_path: Path, monkeypatch):
    with SummaryWriter(str(tmp_path / "SAC_1")) as writer:
        writer.add_scalar("train/return", 1.0, 10)
    monkeypatch.chdir(tmp_path / "SAC_1")
    words = ["runs", "import", ".", "--env", "Hopper-v5", "--store", str(tmp_path / "runs")]
    assert code_of(words) == 0
    run = loaded(tmp_path / "runs", "SAC_1")
    assert run.reader.config["config"]["own"] == {"imported": "SAC_1"}


def test_folders_of_two_settings_are_two_runs(tmp_path: Path):
    for name in ("lr-0.1", "lr-0.2"):
        with SummaryWriter(str(tmp_path / name)) as writer:
            writer.add_scalar("train/return", 1.0, 10)
        words = ["runs", "import", str(tmp_path / name), "--env", "Hopper-v5", "--store"]
        assert code_of([*words, str(tmp_path / "runs")]) == 0
        assert loaded(tmp_path / "runs", name).summary[["env_step"]].tolist() == [10]


def test_a_csv_of_wandb_is_a_run_for_each_of_its_runs(tmp_path: Path):
    steps, table = [100, 200, 300], tmp_path / "wandb_export.csv"
    columns = {"Step": steps, "sac 1 - eval/score": [1, np.nan, 3], "sac 2 - eval/score": [4, 5, 6]}
    columns |= {"sac 2 - eval/score__MAX": [9, 9, 9]}
    pd.DataFrame(columns).to_csv(table, index=False)
    words = ["runs", "import", str(table), "--env", "Pendulum-v1", "--store", str(tmp_path / "r")]
    assert code_of([*words, "--return", "eval/score"]) == 0
    assert loaded(tmp_path / "r", "sac-1").metrics["eval/return"].to_dict() == {100: 1, 300: 3}
    assert loaded(tmp_path / "r", "sac-2").metrics["eval/return"].tolist() == [4, 5, 6]
    assert code_of([*words, "--return", "eval/score"]) == 2  # they are there


def test_the_named_return_is_the_only_one(tmp_path: Path):
    table = tmp_path / "export.csv"
    columns = {"Step": [1, 2], "charts/score": [1, 2], "eval/return": [100, 200]}
    pd.DataFrame(columns).to_csv(table, index=False)
    words = ["runs", "import", str(table), "--env", "Pendulum-v1", "--store", str(tmp_path / "r")]
    assert code_of([*words, "--return", "charts/score"]) == 0
    run = loaded(tmp_path / "r", "export")
    assert run.metrics["eval/return"].tolist() == [1, 2]
    assert run.reader.status.best_return == 2


def test_env_steps_are_those_of_the_training_and_not_of_its_log(tmp_path: Path):
    table = tmp_path / "history.csv"
    columns = {"_step": [1, 2], "global_step": [4000, 8000], "eval/return": [1, 2]}
    pd.DataFrame(columns).to_csv(table, index=False)
    words = ["runs", "import", str(table), "--env", "Pendulum-v1", "--store", str(tmp_path / "r")]
    assert code_of(words) == 0
    run = loaded(tmp_path / "r", "history")
    assert run.metrics["eval/return"].to_dict() == {4000: 1, 8000: 2}


def test_runs_whose_names_become_the_same_are_all_imported(tmp_path: Path):
    table, long = tmp_path / "export.csv", "hopper " * 14
    columns = {f"{long} s{seed} - eval/return": [seed, 2 * seed] for seed in (1, 2, 3)}
    pd.DataFrame({"Step": [1, 2], **columns}).to_csv(table, index=False)
    words = ["runs", "import", str(table), "--env", "Pendulum-v1", "--store", str(tmp_path / "r")]
    assert code_of(words) == 0
    runs = [loaded(tmp_path / "r", path.name) for path in sorted((tmp_path / "r").iterdir())]
    assert [run.metrics["eval/return"].tolist() for run in runs] == [[1, 2], [2, 4], [3, 6]]


@pytest.mark.parametrize("name", ["events.csv", "events.tfevents"])
def test_what_cannot_be_read_makes_no_run(name: str, tmp_path: Path, capsys):
    (tmp_path / name).write_bytes(b"neither events nor columns")
    words = ["runs", "import", str(tmp_path / name), "--env", "Hopper-v5"]
    refused([*words, "--store", str(tmp_path / "runs")], capsys)
    assert not (tmp_path / "runs").exists()
