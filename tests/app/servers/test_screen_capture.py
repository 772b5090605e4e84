"""Moving pictures: which fits they show, and that they are small enough for a README."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from studio_runs import ROAD_TOM

from app.servers import browser
from tom.errors import UserError
from tom.record.reader import RunReader


def test_a_story_goes_through_a_runs_fits(store: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    views = [story.view for story in browser.stories(store)]
    assert views == ["road"]  # the others have two fits
    monkeypatch.setattr(browser, "FEWEST", 2)
    weights, road = browser.stories(store)
    assert weights.view == "weights"
    assert weights.steps == tuple(RunReader(store / weights.run_id).profiles().env_step)
    assert RunReader(store / weights.run_id).learner == "tom"
    assert (road.run_id, road.steps) == (ROAD_TOM, (0, 30, 60))
    assert list(road.addresses())[1] == f"road?run={ROAD_TOM}&step=30"


def test_of_many_fits_some_are_shown_evenly() -> None:
    assert browser.spread([5, 7]) == (5, 7)
    steps = browser.spread(range(0, 3100, 100))
    assert len(steps) == browser.FRAMES
    assert (steps[0], steps[-1]) == (0, 3000)
    assert set(np.diff(steps)) == {200}


@pytest.mark.parametrize("noise", [0, 255])
def test_a_moving_picture_is_small(noise: int, tmp_path: Path) -> None:
    draws = np.random.default_rng(0)
    frames = [
        Image.fromarray((draws.random((400, 640, 3)) * noise).astype(np.uint8)) for _ in range(3)
    ]
    browser.write(frames, tmp_path / "moving.webp")
    assert (tmp_path / "moving.webp").stat().st_size <= browser.LIMIT_BYTES
    with Image.open(tmp_path / "moving.webp") as made:
        assert made.size == (960, 600)
        assert getattr(made, "n_frames", 1) == (3 if noise else 1)


def test_one_that_stays_too_large_is_made_smaller_or_refused(tmp_path: Path) -> None:
    draws = np.random.default_rng(0)
    frames = [Image.fromarray(draws.integers(0, 255, (100, 160, 3), np.uint8)) for _ in range(2)]
    target = tmp_path / "moving.webp"
    coarse = browser.write(frames, target, limit=target_size(frames, target) // 2)
    assert coarse < (browser.SHOWN_WIDTHS[0], browser.QUALITIES[0])
    target.unlink()
    with pytest.raises(UserError, match=r"moving.webp would take .* MB at 480 pixels"):
        browser.write(frames, target, limit=1000)
    assert list(tmp_path.iterdir()) == []


def target_size(frames: list[Image.Image], target: Path) -> int:
    browser.write(frames, target)
    return target.stat().st_size
