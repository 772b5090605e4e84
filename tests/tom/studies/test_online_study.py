"""Profiles of small recorded runs whose every weight is known."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from common import recorded

from tom.events import Tick, Weights
from tom.record import Store
from tom.studies import online as study
from tom.studies.verdicts import verdict_of
from tom.training.presets import resolve

N = 1000


def record(
    store: Store, learner: str, weights: list[np.ndarray], preset: str = "paper", **changes: Any
) -> None:
    """A run that fits its model at steps 250, 500 and so on."""
    config = resolve("hopper", learner, preset, {"snapshots": 0, **changes})
    fits = [Weights(250 * i, one.astype(np.float32)) for i, one in enumerate(weights, start=1)]
    told = (event for fit in fits for event in (fit, Tick(fit.env_step, "fit")))
    recorded(store, store.new_run_id("hopper", learner, 0), config, told)


def on(first: int, last: int) -> np.ndarray:
    """All weight on rows `first` to `last`, evenly."""
    weight = np.zeros(N)
    weight[first:last] = N / (last - first)
    return weight


def test_where_the_weight_lies(tmp_path: Path):
    store = Store(tmp_path)
    record(store, "tom", [np.ones(N), on(500, 600), on(850, 950), on(900, 1000)])
    record(store, "mle", [np.ones(N)] * 4)
    (panel,) = study.panels(store.runs(), ["paper"])
    assert panel.env_step.tolist() == [500, 750, 1000]  # the first fit was uniform
    rows = study.rows([panel])
    assert [row["step"] for row in rows] == [500, 750, 1000]
    assert [row["newest tenth"] for row in rows] == pytest.approx([0, 0.5, 1])
    assert [row["peak at"] for row in rows] == pytest.approx([0.5, 0.85, 0.9])
    assert [row["excess there"] for row in rows] == pytest.approx([0, 0.5, 1])
    assert study.verdict({"online": rows}).word == "No"


def test_of_few_bins_the_newest_is_the_newest_tenth(tmp_path: Path):
    store = Store(tmp_path)
    record(store, "tom", [on(0, 250)], bins=4)
    (panel,) = study.panels(store.runs(), ["paper"])
    assert panel.bins.shape == (1, 4)
    (row,) = study.rows([panel])
    assert (row["newest tenth"], row["excess there"]) == (0, 0)


@pytest.mark.parametrize(
    ("weight", "word"),
    [
        # Nearly even: only a tenth of it lies on the newest tenth, and that is no attention.
        (np.where(np.arange(N) % 20 < 10, 1.1, 0.9), None),
        (np.where(np.arange(N) < 900, 0.7, 3.7), "No"),  # .37 on the newest
        (np.where(np.arange(N) < 500, 0.2, 1.8), "Yes"),
    ],
)
def test_even_weights_are_no_evidence(tmp_path: Path, weight: np.ndarray, word: str | None):
    store = Store(tmp_path)
    record(store, "tom", [weight])
    rows = study.rows(study.panels(store.runs(), ["paper"]))
    assert rows[0]["newest tenth"] < 0.5
    found = verdict_of(study, {"online": rows})
    assert (found.word if found else None) == word


def test_the_longest_runs_and_a_few_fits_spread_over_them(tmp_path: Path):
    store = Store(tmp_path)
    for fits in (20, 3, 16):
        record(store, "pmac", [on(0, 100)] * fits)
    panels = study.panels(store.runs(), ["paper"])
    assert [one.env_step.tolist()[-1] for one in panels] == [5000, 4000]
    (panel,) = study.first_of_each(panels)
    assert panel.env_step.tolist() == [250, 1500, 2750, 3750, 5000]
    assert study.panels(store.runs(), ["smoke"]) == []


def test_presets_stand_beside_each_other_and_runs_with_their_settings_come_first(tmp_path: Path):
    store = Store(tmp_path)
    record(store, "tom", [on(0, 100)] * 2)
    record(store, "tom", [on(0, 100)] * 3, "mended")
    record(store, "tom", [on(0, 100)] * 4, "mended", model={"hidden": 8})
    panels = study.panels(store.runs(), ["paper", "mended"])
    assert [(one.label, len(one.env_step)) for one in panels] == [("TOM", 2), ("TOM, mended", 3)]
    assert {row["learner"] for row in study.rows(panels)} == {"TOM", "TOM, mended"}
    titles = [ax.get_title() for ax in study.online_figure(panels).axes]
    assert titles == ["TOM", "TOM, mended"]
