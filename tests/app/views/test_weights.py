"""Weights: the map of all fits, the chosen one, and what its weights go with."""

import json
from pathlib import Path

import numpy as np
import pytest
from studio_pages import array, captions, draw, figures, metrics, recorded
from studio_runs import PENDULUM_TOM, ROAD_TOM

from app.views.weights import newest_fifth
from tom.record import layout
from tom.record.reader import RunReader

pytestmark = pytest.mark.usefixtures("studio")
RECORD = f"{PENDULUM_TOM}/weights/profiles.jsonl"


def test_every_fit_and_the_chosen_one_are_shown(store: Path) -> None:
    profiles = RunReader(store / PENDULUM_TOM).profiles()
    step = int(profiles.env_step[1])
    app = draw("weights", run=PENDULUM_TOM, step=str(step))
    heat, bars, sample = figures(app)[:3]
    assert array(heat["data"][0]["z"]) == pytest.approx(np.log2(profiles.bins.T).clip(-4, 4))
    assert heat["layout"]["shapes"][0]["x0"] == step
    assert array(bars["data"][0]["y"]) == pytest.approx(profiles.bins[1])
    assert bars["layout"]["yaxis"]["range"][1] >= profiles.bins.max()  # of all fits, so that
    assert array(sample["data"][0]["y"]) == pytest.approx(100 * profiles.ess)  # it stands still
    values = metrics(app)
    assert values["transitions"] == f"{profiles.count[1]:,}"
    assert values["effective sample"] == f"{100 * profiles.ess[1]:.1f} %"
    line = heat["data"][1]  # the returns, below the map and on the same axis
    assert (array(line["x"]).tolist(), array(line["y"]).tolist()) == recorded(store, PENDULUM_TOM)
    assert "xaxis" not in line
    assert heat["layout"]["yaxis2"]["domain"][1] < heat["layout"]["yaxis"]["domain"][0]


def test_fit_after_fit_is_played(store: Path) -> None:
    steps = RunReader(store / PENDULUM_TOM).profiles().env_step.tolist()
    app = draw("weights", run=PENDULUM_TOM)
    app.button(key="play fits").click().run()
    seen = [app.select_slider(key="step").value]
    while app.button(key="play fits").label == "Pause":
        seen.append(app.run().select_slider(key="step").value)
    assert list(dict.fromkeys(seen)) == steps


def test_weights_of_a_fit_that_kept_none_are_not_those_of_another(own: Path) -> None:
    run = own / PENDULUM_TOM
    first, *_, last = RunReader(run).profiles().env_step.tolist()
    (run / layout.snapshot(last)).unlink()
    app = draw("weights", run=PENDULUM_TOM, step=str(last))
    without = len(figures(app))
    choice = app.selectbox(key="kept fit")
    assert f"{last:,}" not in choice.options
    choice.select(first).run()
    assert app.query_params["step"] == str(first)
    assert len(figures(app)) > without


def test_a_fit_whose_weights_are_all_the_same_says_why(own: Path) -> None:
    first, *rest = (own / RECORD).read_text().splitlines()
    even = json.loads(first) | {"bins": [1.0] * 100, "ess": 1.0, "zeros": 0.0}
    (own / RECORD).write_text("\n".join([json.dumps(even), *rest]) + "\n")
    step, last = (str(json.loads(line)["env_step"]) for line in (json.dumps(even), rest[-1]))
    assert "warm-up" in captions(draw("weights", run=PENDULUM_TOM, step=step))
    assert "warm-up" not in captions(draw("weights", run=PENDULUM_TOM, step=last))
    notice = {"env_step": int(step), "kind": "degenerate-weights", "message": "all are zero"}
    with (own / PENDULUM_TOM / "notices.jsonl").open("a") as file:
        file.write(json.dumps(notice) + "\n")
    shown = captions(draw("weights", run=PENDULUM_TOM, step=step))
    assert "unusable" in shown
    assert "warm-up" not in shown


def test_the_last_fit_is_followed_until_another_is_chosen(own: Path) -> None:
    record = own / RECORD
    fit, steps = json.loads(record.read_text().splitlines()[-1]), (200, 400, 500, 600)
    lines = [json.dumps(fit | {"env_step": step}) + "\n" for step in steps]
    record.write_text("".join(lines[:2]))
    app = draw("weights", run=PENDULUM_TOM)
    assert app.select_slider(key="step").value == steps[1]
    record.write_text("".join(lines[:3]))
    assert app.run().select_slider(key="step").value == steps[2]
    app.select_slider(key="step").set_value(steps[0]).run()
    record.write_text("".join(lines[:4]))
    assert app.run().select_slider(key="step").value == steps[0]
    assert not app.exception


def test_a_run_whose_profiles_are_damaged_is_named(own: Path) -> None:
    (own / RECORD).write_text("torn\n")
    app = draw("weights", run=PENDULUM_TOM)
    assert not figures(app)
    assert any("line 1 is damaged" in warning.value for warning in app.warning)


def test_a_step_of_another_run_is_none_of_this() -> None:
    app = draw("weights", run=PENDULUM_TOM, step="200")
    app.selectbox(key="run").select(ROAD_TOM).run()
    assert not app.exception
    assert len(figures(app)) == 5  # no episodes and no policies: two panels less


@pytest.mark.parametrize("bins", [3, 7, 64, 100])
def test_the_newest_fifth_is_a_fifth_for_any_number_of_bins(bins: int) -> None:
    assert newest_fifth(np.ones(bins)) == pytest.approx(0.2)
    assert newest_fifth(np.eye(bins)[-1]) == pytest.approx(min(1, 0.2 * bins))
    assert np.isnan(newest_fifth(np.zeros(bins)))
