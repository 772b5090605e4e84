"""Moving pictures: which fits they show, and that they are small enough for a README."""

import io
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from studio_runs import ROAD_TOM

from app.router import VIEWS
from app.servers import browser
from app.servers.browser import DURATIONS_MS, LIMIT_BYTES, QUALITIES, SHOWN_WIDTHS, animation
from app.views.attention import LEARNERS_ON_IT
from tom.errors import UserError
from tom.record.reader import RunReader


def test_a_story_goes_through_a_runs_fits(store: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert [view for view, *_ in browser.stories(store)] == ["road"]  # the others have two fits
    monkeypatch.setattr(browser, "FEWEST", 2)
    (view, run_id, steps), road = browser.stories(store)
    assert view == "attention"
    assert steps == RunReader(store / run_id).profiles().env_step.tolist()
    assert RunReader(store / run_id).learner == "tom"
    assert road == ("road", ROAD_TOM, [0, 30, 60])


def test_every_page_and_every_part_of_attention_has_a_picture() -> None:
    shown = [(path, choices.get("part", "")) for path, choices in browser.SHOWN.values()]
    assert {path for path, _ in shown} == {view.PATH for view in VIEWS}
    assert {part for path, part in shown if path == "attention"} == {"", LEARNERS_ON_IT}


@pytest.mark.parametrize("noise", [0, 255])
def test_a_moving_picture_is_small(noise: int) -> None:
    draws = np.random.default_rng(0)
    frames = [
        Image.fromarray((draws.random((400, 640, 3)) * noise).astype(np.uint8)) for _ in range(3)
    ]
    made = animation(frames, SHOWN_WIDTHS, QUALITIES, DURATIONS_MS)
    assert len(made) <= LIMIT_BYTES
    with Image.open(io.BytesIO(made)) as shown:
        assert shown.size == (960, 600)
        assert getattr(shown, "n_frames", 1) == (3 if noise else 1)


def test_one_that_stays_too_large_is_made_smaller_or_refused() -> None:
    draws = np.random.default_rng(0)
    frames = [Image.fromarray(draws.integers(0, 255, (100, 160, 3), np.uint8)) for _ in range(2)]
    usual = len(animation(frames, SHOWN_WIDTHS, QUALITIES, DURATIONS_MS))
    assert len(animation(frames, SHOWN_WIDTHS, QUALITIES, DURATIONS_MS, usual // 2)) <= usual // 2
    with pytest.raises(UserError):
        animation(frames, SHOWN_WIDTHS, QUALITIES, DURATIONS_MS, 1000)
