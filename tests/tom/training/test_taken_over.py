"""A training whose run folder another machine takes over at the worst moment."""

import shutil
from pathlib import Path

import pytest

from tom.events import Event
from tom.record import Store, checkpoint, layout
from tom.record.lock import LostError
from tom.record.recorder import Recorder
from tom.training.presets import resolve
from tom.training.run import train

SAVED_AT = 40


def test_a_writer_that_is_replaced_after_its_mark_saves_no_checkpoint(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """It may have slept between the two; the other has saved the same step since."""
    mark, run = Recorder.mark, tmp_path / "a"

    def taken_over(self: Recorder) -> dict:
        made = mark(self)
        (run / layout.LOCK).write_text("another machine")
        checkpoint.save(run / checkpoint.FOLDER, SAVED_AT, {"by": "the other"})
        return made

    monkeypatch.setattr(Recorder, "mark", taken_over)
    given = {"steps": 2 * SAVED_AT, "checkpoint_every": SAVED_AT}
    config = resolve("inverted-pendulum", "mle", "smoke", given)
    with pytest.raises(LostError, match="taken over by another writer"):
        train(config, Store(tmp_path), "a", rerun=False)
    held = checkpoint.load(run / checkpoint.FOLDER)
    assert held is not None
    assert (held.env_step, held.state) == (SAVED_AT, {"by": "the other"})


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
