"""Road and rocks: several runs side by side, each with its own weights."""

from pathlib import Path

import numpy as np
import pytest
from streamlit.testing.v1 import AppTest
from studio_pages import array, draw, figures, trace
from studio_runs import ROAD_MLE, ROAD_TOM

from app.data import pictures
from tom.record.reader import RunReader

pytestmark = pytest.mark.usefixtures("studio")


def weights_shown(app: AppTest) -> list[np.ndarray]:
    return [array(trace(figure, name="weights")["customdata"]) for figure in figures(app)]


def test_two_runs_are_drawn_side_by_side(store: Path) -> None:
    app = draw("road", run=ROAD_TOM, beside=ROAD_MLE, step="60")
    tom, mle = weights_shown(app)
    for shown, run_id in ((tom, ROAD_TOM), (mle, ROAD_MLE)):
        picture = pictures.load(RunReader(store / run_id), 60)
        assert picture is not None
        assert shown == pytest.approx(picture.grid, nan_ok=True)
    assert np.nanmax(tom) > 2
    assert np.nanmax(mle) == pytest.approx(1)


def test_one_run_has_one_map() -> None:
    assert len(weights_shown(draw("road", run=ROAD_MLE))) == 1


def test_the_scene_can_be_shared() -> None:
    button = draw("road", run=ROAD_TOM).get("download_button")[0]
    assert "HTML" in button.proto.label
