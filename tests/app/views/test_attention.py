"""Attention over time: the map, the profile and the numbers at a step are those of the files."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from streamlit.testing.v1 import AppTest
from studio_pages import array, captions, draw, figures, is_chart, parts, recorded
from studio_runs import PENDULUM_TOM

from app.figures.weights import FLOOR
from tom.analysis.answer import newest_share
from tom.record import layout
from tom.record.decode import Profiles
from tom.record.reader import RunReader

pytestmark = pytest.mark.usefixtures("studio")
RECORD = f"{PENDULUM_TOM}/weights/profiles.jsonl"
PROFILE = 1
"""its place among the page's figures"""


def lines(store: Path) -> list[dict[str, Any]]:
    """The profiles of the run's fits, as they lie in its record."""
    return [json.loads(line) for line in (store / RECORD).read_text().splitlines()]


def weights(store: Path, fit: int) -> NDArray[np.float64]:
    return RunReader(store / PENDULUM_TOM).snapshot(fit)["weight"].to_numpy(np.float64)


def follows(app: AppTest) -> list[dict[str, Any] | None]:
    """How each of the page's charts follows the timeline."""
    protos = [part.proto for part in app.get("bidi_component") if is_chart(part.proto)]
    return [json.loads(proto.json)["follows"] for proto in protos]


def test_the_map_the_returns_and_the_profile_are_those_of_the_files(store: Path) -> None:
    fits = lines(store)
    bins = np.array([fit["bins"] for fit in fits])
    app = draw("attention", run=PENDULUM_TOM, step=str(fits[1]["env_step"]))
    heat, bars = figures(app)[:2]
    assert array(heat["data"][0]["x"]).tolist() == [fit["env_step"] for fit in fits]
    assert array(heat["data"][0]["y"])[0] == 0.5  # the oldest hundredth at the bottom
    assert array(heat["data"][0]["z"]) == pytest.approx(np.log2(bins.T.clip(1 / 16, 16)))
    returns = heat["data"][1]
    shown = array(returns["x"]).tolist(), array(returns["y"]).tolist()
    assert shown == recorded(store, PENDULUM_TOM)
    assert heat["layout"]["yaxis2"]["domain"][1] < heat["layout"]["yaxis"]["domain"][0]
    assert array(bars["data"][0]["y"]) == pytest.approx(bins[1].clip(FLOOR))
    low, high = bars["layout"]["yaxis"]["range"]  # of all fits: it stands still
    assert 10**low < FLOOR < bins.max() <= 10**high


def test_the_numbers_of_a_fit_are_those_of_its_single_weights(store: Path) -> None:
    (shown,) = parts(draw("attention", run=PENDULUM_TOM), "tom_readout")
    values = {number["label"]: number["values"] for number in shown["numbers"]}
    kept = RunReader(store / PENDULUM_TOM).snapshot_steps()
    assert len(kept) == 2
    for fit in kept:
        of, at = weights(store, fit), shown["steps"].index(fit)
        assert values["transitions"][at] == f"{len(of):,}"
        newest = of[-len(of) // 5 :].sum() / of.sum()
        expected = {
            "weight on the newest fifth": newest,
            "effective sample": of.sum() ** 2 / (of**2).sum() / len(of),
            "weight zero": (of == 0).mean(),
        }
        for label, share in expected.items():
            assert float(values[label][at].split()[0]) == pytest.approx(100 * share, abs=0.06)


def test_a_fit_that_kept_no_single_weights_shows_the_last_that_did(own: Path) -> None:
    last = lines(own)[-1]["env_step"]
    before = RunReader(own / PENDULUM_TOM).snapshot_steps()[-2]
    (own / PENDULUM_TOM / layout.snapshot(last)).unlink()
    app = draw("attention", run=PENDULUM_TOM, step=str(last))
    (given,) = parts(app, "tom_map")
    assert {one["step"] for one in given["given"]["sources"]} == {before}
    assert f"step {before:,}" in captions(app)


def test_a_fit_whose_weights_are_all_the_same_says_why(own: Path) -> None:
    first, *rest = (own / RECORD).read_text().splitlines()
    even = json.loads(first) | {"bins": [1.0] * 100, "ess": 1.0, "zeros": 0.0}
    (own / RECORD).write_text("\n".join([json.dumps(even), *rest]) + "\n")
    step, last = even["env_step"], json.loads(rest[-1])["env_step"]

    def reasons(at: int) -> list[str]:
        shown = captions(draw("attention", run=PENDULUM_TOM, step=str(at))).splitlines()
        return [line for line in shown if "count the same" in line and f"{at:,}" in line]

    (warm_up,) = reasons(step)
    assert not reasons(last)
    notice = {"env_step": step, "code": "degenerate-weights", "message": "all are zero"}
    with (own / PENDULUM_TOM / "notices.jsonl").open("a") as file:
        file.write(json.dumps(notice) + "\n")
    (unusable,) = reasons(step)
    assert unusable != warm_up


def test_parts_of_the_buffer_without_rows_have_no_weight(own: Path) -> None:
    """Runs of older versions recorded them as NaN, which a browser cannot read."""
    first, *rest = lines(own)
    first["bins"][3] = float("nan")
    (own / RECORD).write_text("".join(json.dumps(line) + "\n" for line in (first, *rest)))
    app = draw("attention", run=PENDULUM_TOM)
    protos = [part.proto.json for part in app.get("bidi_component")]
    assert not any("NaN" in json.dumps(json.loads(given)) for given in protos)
    on_profile = follows(app)[PROFILE]
    assert on_profile is not None
    first = next(iter(on_profile["trace"].values()))
    assert (first["customdata"][3], first["y"][3]) == (0, FLOOR)


@pytest.mark.parametrize("bins", [3, 7, 64, 100])
def test_the_newest_fifth_is_a_fifth_for_any_number_of_bins(bins: int) -> None:
    weights = np.stack([np.ones(bins), np.eye(bins)[-1], np.zeros(bins)])
    step, some = np.arange(3), np.ones(3)
    share = newest_share(Profiles(step, weights, step, some, some, step))
    assert share == pytest.approx([0.2, min(1, 0.2 * bins), np.nan], nan_ok=True)
