"""Checkpoints are written whole, and checked before they are used."""

from pathlib import Path

import pytest
import torch
from common import cut, present

from tom.record import checkpoint


def state(value: float) -> dict:
    return {"x": torch.full((1000,), value), "step": 3, "name": "a", "none": None}


def test_round_trip_and_only_two_are_kept(tmp_path: Path):
    assert checkpoint.load(tmp_path / "nothing") is None
    for step in (100, 200, 300, 300):  # a resumed run saves a step again
        checkpoint.save(tmp_path, step, state(step))
    assert sorted(p.name for p in tmp_path.iterdir()) == ["000000200", "000000300"]
    loaded = present(checkpoint.load(tmp_path))
    assert loaded.env_step == 300
    assert torch.equal(loaded.state["x"], state(300)["x"])
    assert loaded.state["none"] is None
    assert loaded.unusable == {}


@pytest.mark.parametrize("damage", ["truncate", "no manifest", "newer schema"])
def test_a_damaged_checkpoint_is_named_and_the_previous_one_used(tmp_path: Path, damage: str):
    checkpoint.save(tmp_path, 1, state(1))
    path = checkpoint.save(tmp_path, 2, state(2))
    match damage:
        case "truncate":
            cut(path / "state.pt")
        case "no manifest":
            (path / "manifest.json").unlink()
        case "newer schema":
            (path / "manifest.json").write_text('{"schema": 99}')
    loaded = present(checkpoint.load(tmp_path))
    assert loaded.env_step == 1
    assert list(loaded.unusable) == [path]
