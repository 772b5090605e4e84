"""`tom train --run-id NAME --resume auto`, given again and again by a script."""

import json
import os
import signal
from multiprocessing import get_context
from pathlib import Path

import pytest

from tom.cli import main
from tom.errors import TRY_LATER, UserError
from tom.events import Event
from tom.record import Store, checkpoint, lock, manage
from tom.training.presets import resolve
from tom.training.run import train

STEPS = 60
CONFIG = resolve("inverted-pendulum", "mle", "smoke", {"steps": STEPS})
WORDS = ["--env", "inverted-pendulum", "--learner", "mle", "--preset", "smoke", "--no-rerun"]


def command(store: Path, *more: str) -> list[str]:
    named = ["--run-id", "mine", "--resume", "auto", "--store", str(store), "--json"]
    return ["train", *WORDS, "--steps", str(STEPS), *named, *more]


def killed(store: Path) -> None:
    """Train in this process until a `kill -9` before the first checkpoint."""

    def end(event: Event) -> None:
        if event.env_step == STEPS // 2:
            os.kill(os.getpid(), signal.SIGKILL)

    train(CONFIG, Store(store), "mine", rerun=False, watchers=[end])


def begun(store: Path) -> None:
    """A run that was killed before its first checkpoint."""
    process = get_context("fork").Process(target=killed, args=(store,))
    process.start()
    process.join()
    assert process.exitcode == -signal.SIGKILL
    assert checkpoint.newest(store / "mine" / checkpoint.FOLDER) is None


def test_a_named_run_that_died_before_its_first_checkpoint_begins_anew(tmp_path: Path, capsys):
    begun(tmp_path)
    assert main(command(tmp_path)) == 0
    said = capsys.readouterr()
    assert json.loads(said.out)["state"] == "finished"
    assert f"the old folder is in {tmp_path / '.trash' / 'mine'}" in said.err
    assert manage.trashed(Store(tmp_path)) == ["mine"]
    assert main(command(tmp_path)) == 0  # it is done
    assert manage.trashed(Store(tmp_path)) == ["mine"]


def test_a_named_run_that_is_being_written_is_left_alone(tmp_path: Path, capsys):
    begun(tmp_path)
    writer = lock.acquire(tmp_path / "mine")
    try:
        assert main(command(tmp_path)) == TRY_LATER
    finally:
        writer.close()
    error = capsys.readouterr().err
    assert "run 'mine' is being written by another process" in error
    assert error.count("\n") == 1
    assert manage.trashed(Store(tmp_path)) == []


def test_a_run_of_other_settings_keeps_its_name(tmp_path: Path, capsys):
    begun(tmp_path)
    assert main(command(tmp_path, "--sac.lr", "0.1")) == 2
    assert "'mine' exists already" in capsys.readouterr().err
    with pytest.raises(UserError, match="exists already"):
        train(CONFIG, Store(tmp_path), "mine", rerun=False)
    assert manage.trashed(Store(tmp_path)) == []


def test_a_named_run_that_was_given_more_steps_is_done_once_it_has_these(tmp_path: Path):
    assert main(command(tmp_path)) == 0
    more = ["--resume", "mine", "--steps", str(2 * STEPS), "--no-rerun", "--store", str(tmp_path)]
    assert main(["train", *more]) == 0
    metrics = (tmp_path / "mine" / "metrics.jsonl").read_bytes()
    assert main(command(tmp_path)) == 0
    assert (tmp_path / "mine" / "metrics.jsonl").read_bytes() == metrics


def test_a_named_run_whose_checkpoint_can_never_go_on_begins_anew(tmp_path: Path):
    begun(tmp_path)
    checkpoint.save(tmp_path / "mine" / checkpoint.FOLDER, 20, {"of": "another version"})
    assert main(command(tmp_path)) == 0
    assert manage.trashed(Store(tmp_path)) == ["mine"]
    assert main(["train", "--resume", "mine", "--store", str(tmp_path / ".trash")]) == 2
