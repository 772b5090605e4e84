"""The printed script, run by bash as Slurm would run one of its tasks."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from kernel import wait_for

from tom.cli import main
from tom.record import RunReader
from tom.sweep.engine import script
from tom.training.plan import checked, trials

PLAN = {"env": ["inverted-pendulum"], "learner": ["mle", "tom"], "preset": "smoke"}


def test_one_task_for_each_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys):
    words = ["sweep", "--env", "hopper", "--learner", "tom", "mle", "--seeds", "0", "1", "2"]
    monkeypatch.setattr(sys, "argv", ["tom", *words, "--engine", "slurm"])
    assert main([*words, "--engine", "slurm", "--store", str(tmp_path)]) == 0
    text = capsys.readouterr().out
    assert "#SBATCH --array=0-5\n" in text
    assert "--engine" not in text
    assert " ".join(words) in text
    assert subprocess.run(["bash", "-n"], input=text.encode(), check=False).returncode == 0


def test_the_time_follows_the_projection(tmp_path: Path):
    planned = trials(checked(PLAN))
    assert "--time=24:00:00" in script(len(planned), tmp_path, [], None)
    assert "--time=5:00:00" in script(len(planned), tmp_path, [], 3.1)


@pytest.mark.fault
def test_the_time_of_a_slurm_task_is_up__leaves_a_checkpoint_and_queues_again(tmp_path: Path):
    words = ["sweep", "--env", "inverted-pendulum", "--learner", "mle", "tom", "--preset", "smoke"]
    words += ["--steps", "100000", "--store", str(tmp_path / "store")]
    planned = trials(checked({**PLAN, "steps": 100000}))
    file = tmp_path / "sweep.sh"
    file.write_text(script(len(planned), tmp_path / "store", words, 1.0))
    queue = tmp_path / "bin/scontrol"  # stands in for Slurm's: it notes what it is asked
    queue.parent.mkdir()
    queue.write_text(f'#!/bin/sh\necho "$@" > {tmp_path}/asked\n')
    queue.chmod(0o755)
    # A node has no `tom` on its path.
    task = {
        "PATH": f"{queue.parent}:/usr/bin:/bin",
        "SLURM_ARRAY_TASK_ID": "1",
        "SLURM_ARRAY_JOB_ID": "77",
    }
    process = subprocess.Popen(["bash", str(file)], env={**os.environ, **task})
    run_id = planned[1].run_id
    run = tmp_path / "store" / run_id
    wait_for(lambda: run.is_dir() and RunReader(run).status.env_step > 300)
    process.send_signal(signal.SIGTERM)
    assert process.wait(60) == 0
    assert (tmp_path / "asked").read_text() == "requeue 77_1\n"
    status = RunReader(run).status
    assert status.state == "stopped"
    assert "--resume" in status.reason
