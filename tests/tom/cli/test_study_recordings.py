"""The recordings of SAC that studies make: one that was stopped goes on where it was."""

import signal
from argparse import Namespace
from functools import partial
from pathlib import Path

import pytest

from tom.cli.output import ProgressReport
from tom.cli.reproduce import record
from tom.events import Event, Tick
from tom.record import RunReader, Store
from tom.studies.study import recordings

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
