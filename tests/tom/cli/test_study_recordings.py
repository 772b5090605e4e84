"""The recordings of SAC that studies make: one that was stopped goes on where it was."""

import signal
from argparse import Namespace
from functools import partial
from pathlib import Path
from types import ModuleType

import pytest

from tom.cli.output import ProgressReport
from tom.cli.reproduce import record, run
from tom.config import SacRecordingConfig
from tom.events import Event, Tick
from tom.record import RunReader, Store
from tom.studies.study import Findings, recordings

STEPS = 150


def recorded(folder: Path) -> list[RunReader]:
    args = Namespace(out=folder / "out", store=folder / "store", env=["inverted-pendulum"])
    args.steps, args.record = STEPS, partial(record, args)
    return recordings(args, [0])


def test_a_recording_that_was_stopped_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    store, consume = Store(tmp_path / "store"), ProgressReport.consume

    def interrupt(self: ProgressReport, event: Event) -> None:
        consume(self, event)
        if isinstance(event, Tick) and event.env_step >= STEPS:
            signal.raise_signal(signal.SIGTERM)

    with monkeypatch.context() as patched:
        patched.setattr(ProgressReport, "consume", interrupt)
        with pytest.raises(KeyboardInterrupt):
            recorded(tmp_path)
    (stopped,) = store.runs()
    assert stopped.status.state == "stopped"
    (made,) = recorded(tmp_path)
    assert (made.run_id, made.status.state) == (stopped.run_id, "finished")
    assert len(made.buffer()[0]) == 2 * STEPS
    assert recorded(tmp_path)[0].run_id == made.run_id
    assert len(store.runs()) == 1


def test_a_recording_whose_loss_is_not_finite_ends_the_study_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    def steep(args: Namespace) -> Findings:
        settings = SacRecordingConfig(env="inverted-pendulum", steps=STEPS, exploration_steps=40)
        settings = settings.but(sac={"hidden": 16, "batch_size": 32, "lr": 1e20})
        args.record(Store(tmp_path), settings)
        raise AssertionError

    study = ModuleType("steep")
    vars(study).update(TITLE="Steep", CLAIM="", find=steep)
    assert run(study, Namespace(out=tmp_path / "out")) == 1
    said = capsys.readouterr().err.strip().splitlines()
    assert said[-1].startswith("failed: step ")
    assert "--sac.lr" in said[-1]
