"""The pages of a training loop of one's own: as far as there is data, and what gives the rest."""

from pathlib import Path

import numpy as np
import pytest
from loops import loaded, of_two
from streamlit.testing.v1 import AppTest
from studio_pages import Show, array, draw, figures

from app.parts import widgets
from tom.learners import learner_label
from tom.own_loop.live import weigh_live
from tom.own_loop.run import record
from tom.record.reader import RunReader

PAGES = ("answer", "curves", "attention", "replays")
RETURNS = [-9.0, -4.0]


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A loop with nothing but numbers, one with its own weights, one that is weighed live."""
    path, rng = tmp_path_factory.mktemp("loops"), np.random.default_rng(0)
    for name in ("bare", "weighs", "live", "only-live"):
        live = None
        with record(name, env="Pendulum-v1", store=path, steps=400) as run:
            for step in (200, 400):
                rows, no = rng.normal(size=(200, 3)), np.zeros(200, bool)
                if name != "bare":
                    cut = no | (np.arange(200) % 50 == 49)
                    run.transitions(rows, rows[:, :1] / 9, rows[:, 0], rows, no, cut)
                run.metrics(step, {"eval/return": RETURNS[step // 200 - 1]})
                if name == "weighs":
                    run.weights(step, np.arange(step) + 1.0)
            if name == "live":
                run.weights(400, np.arange(400) + 1.0)
            if "live" in name:
                run.policy(400, lambda obs: obs[:, :1])
                run.episode(400, rng.normal(size=(11, 3)), np.ones(10))
                live = weigh_live(run, ("pmac", "tom"), every=100)
        if live is not None:
            live.wait(120)
    return path


@pytest.fixture(autouse=True)
def shown(store: Path, show: Show):
    show(store)


def has_returns(app: AppTest) -> bool:
    """Whether a line of the page's first figure has the loop's returns."""
    lines = [array(line["y"]) for line in figures(app)[0]["data"] if "y" in line]
    return any(line.tolist() == RETURNS for line in lines)


@pytest.mark.parametrize("page", PAGES)
@pytest.mark.parametrize("run", ["bare", "weighs", "live"])
def test_every_page_opens(page: str, run: str):
    app = draw(page, run=run)
    assert not app.error
    if page == "curves":
        assert has_returns(app)


@pytest.mark.parametrize(
    ("run", "by", "fits"), [("weighs", "own-loop", 2), ("live", "own-loop", 1), ("live", "tom", 1)]
)
def test_weights_of_the_loop_and_live_ones_are_shown_with_its_returns(run, by, fits, store: Path):
    app = draw("attention", run=run, by=by)
    drawn = [trace for figure in figures(app) for trace in figure["data"]]
    [heat] = [trace for trace in drawn if trace["type"] == "heatmap"]
    assert array(heat["z"]).shape[1] == fits
    assert has_returns(app)
    found = loaded(store, run)
    bins = (found if by == "own-loop" else found.live[by]).profiles.to_numpy()[-1]
    lines = [array(trace["y"]) for trace in drawn if "y" in trace]
    assert any(y.shape == bins.shape and np.allclose(y, bins) for y in lines)


def test_curves_has_the_metrics_of_live_weights(store: Path):
    app = draw("curves", run="only-live", panel="weights/ess")
    ess = loaded(store, "only-live").live["tom"].metrics["weights/ess"].dropna().tolist()
    drawn = [array(trace["y"]) for figure in figures(app) for trace in figure["data"]]
    assert any(y.tolist() == pytest.approx(ess) for y in drawn if len(y) == len(ess))


def test_live_weights_of_all_learners_are_compared(store: Path):
    app = draw("attention", run="live", part="Every learner on one buffer")
    ess = app.dataframe[0].value.set_index("learner")["ESS"].to_dict()
    for learner, live in loaded(store, "live").live.items():
        weight = live.weights()["weight"].to_numpy()
        expected = weight.sum() ** 2 / (weight**2).sum() / 400
        assert ess[learner_label(learner)] == pytest.approx(expected, rel=1e-4)


def test_the_newest_episode_is_that_of_the_record_s_newest_row(
    tmp_path: Path, show: Show, monkeypatch: pytest.MonkeyPatch
):
    rows = RunReader(of_two(tmp_path)).buffer_length()
    asked: list[dict[str, str]] = []
    monkeypatch.setattr(widgets, "link_to", lambda *_, **choices: asked.append(choices))
    show(tmp_path)
    assert not draw("replays", run="two").exception
    assert asked[0]["row"] == str(rows - 1)
