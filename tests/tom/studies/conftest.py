"""A small training whose frozen buffer and policies several studies examine."""

import pytest

from tom.record import RunReader, Store
from tom.training.presets import resolve
from tom.training.run import train

SMALL = {"steps": 1500, "snapshots": 10, "sac": {"hidden": 16, "batch_size": 32}}


@pytest.fixture(scope="session")
def run(tmp_path_factory: pytest.TempPathFactory) -> RunReader:
    """A run called `frozen`; whoever changes it takes a copy."""
    config = resolve("hopper", "mle", "smoke", SMALL)
    return train(config, Store(tmp_path_factory.mktemp("store")), "frozen", rerun=False)
