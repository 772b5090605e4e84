"""Files of arrays in which a bit is flipped, or that are cut."""

from pathlib import Path

import numpy as np
import pytest
from faults import config, stopped

from tom.errors import UserError
from tom.policy.stored import read_policy
from tom.record import RunReader, Store
from tom.record.export import export_small
from tom.training.run import train

pytestmark = pytest.mark.fault


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store with a stopped run and a finished one."""
    path = tmp_path_factory.mktemp("made") / "store"
    stopped(Store(path), 130, "a")
    train(config("tom"), Store(path), "whole", rerun=False)
    return path


def test_a_bit_flipped_anywhere_in_a_small_copys_arrays__raises_nothing(
    store: Store, tmp_path: Path
):
    copy = RunReader(export_small(store.run("whole"), tmp_path / "copies"))
    rng = np.random.default_rng(0)
    files = [p for p in sorted(copy.path.rglob("*")) if p.suffix in (".npz", ".parquet")]
    assert len(files) > 6
    for path in files:
        content = bytearray(path.read_bytes())
        ends = [*range(150), *range(len(content) - 150, len(content))]
        for at in {*ends, *rng.integers(0, len(content), 60).tolist()} & {*range(len(content))}:
            bit = 1 << int(rng.integers(8))
            content[at] ^= bit
            path.write_bytes(content)
            content[at] ^= bit
            read(copy.path, path)
        path.write_bytes(content)


def read(run: Path, path: Path) -> None:
    """Read the part of the run that `path` is, as the pages do."""
    reader = RunReader(run)
    match path.parent.name:
        case "buffer":
            reader.recorded()
        case "episodes":
            reader.episodes(int(path.stem))
        case "weights":
            reader.snapshot(int(path.stem.partition("-")[2]))
        case _:
            try:
                read_policy(path)
            except UserError:
                return
