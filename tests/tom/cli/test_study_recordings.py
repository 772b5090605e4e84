"""The recordings of SAC that studies make: one that was stopped goes on where it was."""

import argparse
import signal
from pathlib import Path

import pytest

from tom.cli.progress import ProgressReport
from tom.cli.reproduce import study
from tom.cli.reproduce.study import sac_recordings, stoppable
from tom.config import SacRecordingConfig
from tom.events import Event, Tick
from tom.record import Store

STEPS = 150


def test_a_recording_that_was_stopped_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    store, consume = Store(tmp_path), ProgressReport.consume

    def interrupt(self: ProgressReport, event: Event) -> None:
        consume(self, event)
        if isinstance(event, Tick) and event.env_step >= STEPS:
            signal.raise_signal(signal.SIGTERM)

    with monkeypatch.context() as patched:
        patched.setattr(ProgressReport, "consume", interrupt)
        with pytest.raises(KeyboardInterrupt):
            sac_recordings(store, ["inverted-pendulum"], [0], STEPS)
    (stopped,) = store.runs()
    assert stopped.status.state == "stopped"
    (made,) = sac_recordings(store, ["inverted-pendulum"], [0], STEPS)
    assert (made.run_id, made.status.state) == (stopped.run_id, "finished")
    assert len(made.buffer()[0]) == 2 * STEPS
    assert sac_recordings(store, ["inverted-pendulum"], [0], STEPS)[0].run_id == made.run_id
    assert len(store.runs()) == 1


def test_a_recording_whose_loss_is_not_finite_ends_the_study_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    def steep(env: str, seed: int, steps: int) -> SacRecordingConfig:
        settings = SacRecordingConfig(env=env, seed=seed, steps=steps, exploration_steps=40)
        return settings.but(sac={"hidden": 16, "batch_size": 32, "lr": 1e20})

    def work(args: argparse.Namespace) -> int:
        return len(sac_recordings(Store(tmp_path), ["inverted-pendulum"], [0], STEPS))

    monkeypatch.setattr(study, "recording_config", steep)
    assert stoppable(work)(argparse.Namespace()) == 1
    said = capsys.readouterr().err.strip().splitlines()
    assert said[-1].startswith("failed: step ")
    assert "--sac.lr" in said[-1]
