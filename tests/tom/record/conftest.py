"""Runs recorded for real in a store of their own."""

from collections.abc import Callable
from pathlib import Path

import pytest
from recorded import Config, events

from tom.events import Event
from tom.record import RunReader, Store
from tom.record.recorder import Recorder
from tom.record.writer import RunWriter


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store(tmp_path / "a store")


@pytest.fixture
def record(store: Store) -> Callable[..., RunReader]:
    """Record events (default: all of them) as a run and read it back."""

    def run(run_id: str = "run", given: list[Event] | None = None) -> RunReader:
        with Recorder(RunWriter.create(store, run_id, Config, command="tom train")) as recorder:
            for event in events() if given is None else given:
                recorder.consume(event)
        return store.run(run_id)

    return run
