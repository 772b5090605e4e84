"""Files that declare, or inflate to, more than a run can have; files in which a bit is flipped."""

import hashlib
import json
import shutil
import tracemalloc
import zipfile
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from faults import config, stopped
from torch import _utils

from tom.cli import main
from tom.errors import UserError
from tom.policy.stored import read_policy
from tom.record import RunReader, Store, checkpoint
from tom.record.export import export_small
from tom.record.integrity import repair, verify
from tom.training.resume import resume
from tom.training.run import train

pytestmark = [pytest.mark.fault, pytest.mark.quick]

BOMB_BYTES = 320 * 2**20
"""more than a run of 240 steps can have; packed, it is less than a megabyte"""


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store with a stopped run and a finished one."""
    path = tmp_path_factory.mktemp("made") / "store"
    stopped(Store(path), 130, "a")
    train(config("tom"), Store(path), "whole", rerun=False)
    return path


@pytest.fixture
def store(made: Path, tmp_path: Path) -> Store:
    return Store(shutil.copytree(made, tmp_path / "store"))


def declare(path: Path, shape: tuple[int, ...]) -> None:
    """Let every array of an .npz file declare `shape`, and hold what it held."""
    with np.load(path) as file:
        arrays = {name: file[name] for name in file.files}
    with zipfile.ZipFile(path, "w") as archive:
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w") as part:
                header = {"descr": array.dtype.str, "fortran_order": False, "shape": shape}
                np.lib.format.write_array_header_1_0(part, header)
                part.write(array.tobytes())


def inflate(path: Path) -> None:
    """Add an array of zeros to an .npz file, which packs to nothing."""
    with (
        zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED, compresslevel=1) as archive,
        archive.open("zeros.npy", "w") as part,
    ):
        shape = (BOMB_BYTES // 4,)
        header = {"descr": "<f4", "fortran_order": False, "shape": shape}
        np.lib.format.write_array_header_1_0(part, header)
        for _ in range(BOMB_BYTES // 2**20):
            part.write(bytes(2**20))
    assert path.stat().st_size < 2 * 2**20


def repeat(path: Path) -> None:
    """One weight, so often that a column of them is as long as the bomb."""
    column = pa.array(np.zeros(BOMB_BYTES // 4, np.float32))
    pq.write_table(pa.table({"weight": column}), path, compression="zstd", use_dictionary=True)
    assert path.stat().st_size < 2**20


def text(path: Path) -> None:
    """A column of words, each of which may be as long as the file."""
    pq.write_table(pa.table({"weight": ["x" * 100_000] * 1000}), path)


def spoilt(name: str, how: str) -> Callable[[Path], None]:
    if name.endswith(".parquet"):
        return repeat if how == "inflates" else text
    return inflate if how == "inflates" else lambda path: declare(path, (10**11, 4))


def last(run: RunReader, part: str) -> str:
    """The name of the last file of a part of a run: nothing comes after it."""
    path = max((run.path / part).iterdir()) if (run.path / part).is_dir() else run.path / part
    return str(path.relative_to(run.path))


@pytest.mark.parametrize("how", ["declares too much", "inflates"])
@pytest.mark.parametrize("part", ["buffer", "episodes", "weights", "policies", "policy.npz"])
def test_a_file_of_arrays_larger_than_its_run_can_have__is_named_before_anything_is_made_of_it(
    store: Store, part: str, how: str, capsys: pytest.CaptureFixture[str]
):
    run = store.run("whole")
    name = last(run, part) if part != "weights" else f"weights/{_snapshot(run)}"
    spoilt(name, how)(run.path / name)
    tracemalloc.start()
    problems = verify(run)
    assert main(["runs", "verify", "--store", str(store.path)]) == 1
    assert "2 runs read, 1 with problems" in capsys.readouterr().out
    export_small(run, store.path / "copies")
    done = repair(run)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert [name in problem for problem in problems] == [True], problems
    assert any(f"damaged/{name}" in line for line in done)
    assert verify(run) == []
    assert peak < BOMB_BYTES / 4


def _snapshot(run: RunReader) -> str:
    return f"snapshot-{run.snapshot_steps()[0]:09d}.parquet"


@pytest.mark.parametrize("how", ["declares too much", "inflates"])
def test_a_buffer_larger_than_its_run_can_have__resume_says_so_and_touches_nothing(
    store: Store, how: str
):
    path = store.path / "a" / "buffer" / "000000000.npz"
    spoilt(path.name, how)(path)
    with pytest.raises(UserError, match="lost rows of its buffer"):
        resume(store, "a", rerun=False)
    assert store.run("a").status.state == "stopped"


@pytest.mark.parametrize("how", ["declares too much", "inflates"])
def test_a_policy_larger_than_any__is_refused_in_one_line(store: Store, how: str):
    path = store.path / "whole" / "policy.npz"
    spoilt(path.name, how)(path)
    with pytest.raises(UserError, match="is no stored policy"):
        read_policy(path)


def test_segments_of_different_widths__the_buffer_ends_at_the_first_that_differs(store: Store):
    run = store.run("whole")
    path = run.path / "buffer" / "000000000.npz"
    with np.load(path) as file:
        arrays = {name: file[name] for name in file.files}
    count = len(arrays["reward"])
    arrays["obs"] = np.zeros((count, 99), np.float32)
    np.savez(run.path / "buffer" / f"{count:09d}.npz", allow_pickle=False, **arrays)
    assert len(run.buffer()[0]) == count
    assert "another width" in run.problems[0]


class Crafted:
    """A tensor that says it has `shape` and `stride`, over one number."""

    def __init__(self, shape: tuple[int, ...], stride: tuple[int, ...]) -> None:
        self.arguments = torch.zeros(1).untyped_storage(), 0, shape, stride

    def __reduce__(self):
        untyped, *rest = self.arguments
        storage = torch.storage.TypedStorage(
            wrap_storage=untyped, dtype=torch.float32, _internal=True
        )
        return _utils._rebuild_tensor_v2, (storage, *rest, False, OrderedDict())


def crafted(path: Path, how: str) -> None:
    state = torch.load(path, weights_only=True)
    match how:
        case "packed":
            with zipfile.ZipFile(path) as archive:
                parts = {name: archive.read(name) for name in archive.namelist()}
            with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
                for name, part in parts.items():
                    archive.writestr(name, part)
        case "of the old format":
            torch.save(state, path, _use_new_zipfile_serialization=False)
        case "expanded":
            torch.save({**state, "more": torch.zeros(1).expand(10**12)}, path)
        case "with strides that do not fit":
            torch.save({**state, "more": Crafted((3, 4), ())}, path)
        case "beyond its storage":
            torch.save({**state, "more": Crafted((10**9,), (1,))}, path)
        case "sparse":
            torch.save({**state, "more": torch.zeros(10**4, 10**4).to_sparse()}, path)
        case "of no training":
            torch.save([1, 2], path)
        case _:
            held: list[object] = []
            for _ in range(60):
                held = [held, held]
            torch.save({**state, "more": held}, path)
            torch.load(path, weights_only=True)
    manifest = json.loads((path.parent / "manifest.json").read_text())
    manifest["sha256"] = hashlib.sha256(path.read_bytes()).hexdigest()
    (path.parent / "manifest.json").write_text(json.dumps(manifest))


@pytest.mark.parametrize(
    "how",
    [
        "packed",
        "of the old format",
        "expanded",
        "with strides that do not fit",
        "beyond its storage",
        "sparse",
        "of no training",
    ],
)
def test_a_crafted_checkpoint__is_named_and_the_one_before_used(store: Store, how: str):
    folder = store.path / "a" / checkpoint.FOLDER
    newest = folder / f"{checkpoint.newest(folder):09d}"
    crafted(newest / "state.pt", how)
    held = checkpoint.load(folder)
    assert held is not None
    assert newest.name in held.problems[0]
    assert newest.name in "".join(verify(store.run("a")))
    done = resume(store, "a", rerun=False)
    assert any(newest.name in text for text in done.status.warnings)


def test_lists_in_a_checkpoint_that_hold_one_another__are_looked_through_once(store: Store):
    folder = store.path / "a" / checkpoint.FOLDER
    crafted(folder / f"{checkpoint.newest(folder):09d}" / "state.pt", "nested")
    held = checkpoint.load(folder)
    assert held is not None
    assert held.problems == []


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
            reader.buffer()
            reader.buffer_state()
        case "episodes":
            reader.episodes(int(path.stem))
        case "weights":
            reader.snapshot(int(path.stem.partition("-")[2]))
        case _:
            try:
                read_policy(path)
            except UserError:
                return


@pytest.mark.parametrize("part", ["episodes", "buffer", "policy.npz", "weights"])
def test_a_cut_array_file__is_left_out_of_a_small_copy(store: Store, tmp_path: Path, part: str):
    run = store.run("whole")
    path = run.path / (last(run, part) if part != "weights" else f"weights/{_snapshot(run)}")
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    copy = RunReader(export_small(run, tmp_path / "copies"))
    assert copy.status.state == "finished"
    assert len(copy.metrics()) > 3
    assert verify(copy) == []
