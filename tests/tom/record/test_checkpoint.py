"""Checkpoints are written whole, and checked before they are used."""

import subprocess
import sys
from pathlib import Path

import pytest
import torch

from tom.record import checkpoint, layout, lock
from tom.record.lock import LostError


def state(value: float) -> dict:
    return {"x": torch.full((1000,), value), "step": 3, "name": "a", "none": None}


def test_round_trip_and_only_two_are_kept(tmp_path: Path):
    for step in (100, 200, 300):
        checkpoint.save(tmp_path, step, state(step))
    assert sorted(p.name for p in tmp_path.iterdir()) == ["000000200", "000000300"]
    loaded = checkpoint.load(tmp_path)
    assert loaded is not None
    assert loaded.env_step == 300
    assert torch.equal(loaded.state["x"], state(300)["x"])
    assert loaded.state["none"] is None
    assert loaded.problems == []


@pytest.mark.parametrize("damage", ["flip", "truncate", "no manifest", "newer schema"])
def test_a_damaged_checkpoint_is_named_and_the_previous_one_used(tmp_path: Path, damage: str):
    checkpoint.save(tmp_path, 1, state(1))
    path = checkpoint.save(tmp_path, 2, state(2))
    content = (path / "state.pt").read_bytes()
    middle = len(content) // 2
    match damage:
        case "flip":
            flipped = bytes([content[middle] ^ 1])
            content = content[:middle] + flipped + content[middle + 1 :]
            (path / "state.pt").write_bytes(content)
        case "truncate":
            (path / "state.pt").write_bytes(content[:middle])
        case "no manifest":
            (path / "manifest.json").unlink()
        case "newer schema":
            (path / "manifest.json").write_text('{"schema": 99}')
    loaded = checkpoint.load(tmp_path)
    assert loaded is not None
    assert loaded.env_step == 1
    assert "000000002" in loaded.problems[0]


WITHOUT_MEMORY = """
import resource, sys
from pathlib import Path
import torch
from tom.record import checkpoint

status = Path("/proc/self/status").read_text()
[held] = [line.split()[1] for line in status.splitlines() if line.startswith("VmData:")]
limit = 1024 * int(held) + 30_000_000
resource.setrlimit(resource.RLIMIT_DATA, (limit, limit))
try:
    checkpoint.load(Path(sys.argv[1]))
except MemoryError as error:
    print(error)
"""
"""in a process of its own: one that has trained keeps freed memory, and would read from it"""


@pytest.mark.fault
@pytest.mark.quick
def test_no_memory_for_a_checkpoint__is_no_damage_of_it(tmp_path: Path):
    for step in (1, 2):
        checkpoint.save(tmp_path, step, {"x": torch.zeros(25_000_000)})
    command = [sys.executable, "-c", WITHOUT_MEMORY, str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stdout.startswith("checkpoint 000000002")
    loaded = checkpoint.load(tmp_path)
    assert loaded is not None
    assert (loaded.env_step, loaded.problems) == (2, [])


def test_code_in_a_checkpoint_is_not_executed(tmp_path: Path):
    class Evil:
        def __reduce__(self):
            return (Path.touch, (tmp_path / "executed",))

    checkpoint.save(tmp_path, 1, {"x": Evil()})
    assert checkpoint.load(tmp_path) is None
    assert not (tmp_path / "executed").exists()


def test_the_same_step_may_be_saved_again(tmp_path: Path):
    checkpoint.save(tmp_path, 5, state(1))
    checkpoint.save(tmp_path, 5, state(2))
    loaded = checkpoint.load(tmp_path)
    assert loaded is not None
    assert loaded.state["x"][0] == 2


def test_a_writer_that_is_replaced_while_it_saves_leaves_what_is_there(tmp_path: Path):
    """It was thought dead, and another machine has saved that step meanwhile."""
    held = lock.acquire(tmp_path)
    folder = tmp_path / checkpoint.FOLDER

    class TakesLong:
        def __reduce__(self):
            return (str, (str((tmp_path / layout.LOCK).write_text("another machine")),))

    checkpoint.save(folder, 5, state(1))
    with pytest.raises(LostError):
        checkpoint.save(folder, 5, {"x": TakesLong()}, held.check)
    held.close()
    assert [path.name for path in folder.iterdir()] == ["000000005"]
    loaded = checkpoint.load(folder)
    assert loaded is not None
    assert loaded.state["x"][0] == 1


@pytest.mark.parametrize("name", ["²", "1" * 30, "000000007.old", "٧"])  # noqa: RUF001
def test_a_folder_that_is_no_checkpoint_is_passed_over(name: str, tmp_path: Path):
    checkpoint.save(tmp_path, 5, state(1))
    (tmp_path / name).mkdir()
    assert checkpoint.newest(tmp_path) == 5
    checkpoint.save(tmp_path, 6, state(1))
    assert (tmp_path / name).is_dir()


def test_an_empty_folder_has_none(tmp_path: Path):
    assert checkpoint.load(tmp_path / "nothing") is None
