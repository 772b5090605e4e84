"""Runs recorded for real in a store of their own."""

from collections.abc import Callable
from pathlib import Path

import pytest
from common import recorded
from recorded import Config, events

from tom.events import Event
from tom.record import RunReader, Store


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store(tmp_path / "a store")


@pytest.fixture
def record(store: Store) -> Callable[..., RunReader]:
    """Record events (default: all of them) as a run and read it back."""

    def run(run_id: str = "run", given: list[Event] | None = None) -> RunReader:
        return recorded(store, run_id, Config, events() if given is None else given)

    return run
