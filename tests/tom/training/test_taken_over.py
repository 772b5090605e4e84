"""A training whose run folder another machine takes over at the worst moment."""

import shutil
from pathlib import Path

import pytest

from tom.events import Event
from tom.record import Store
from tom.record.lock import LostError
from tom.training.presets import resolve
from tom.training.run import train

SAVED_AT = 40


@pytest.mark.parametrize("gone", ["renamed", "removed"])
def test_a_run_folder_that_is_gone_is_not_said_to_be_taken_over(tmp_path: Path, gone: str):
    config = resolve("inverted-pendulum", "mle", "smoke", {"steps": 2 * SAVED_AT})
    run = tmp_path / "a"

    def lose(event: Event) -> None:
        if event.env_step == SAVED_AT and run.exists():
            run.rename(tmp_path / "b") if gone == "renamed" else shutil.rmtree(run)

    with pytest.raises(LostError, match="moved or removed"):
        train(config, Store(tmp_path), "a", rerun=False, watchers=(lose,))
    assert not run.exists()
