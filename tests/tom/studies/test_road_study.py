from dataclasses import replace
from math import isnan

import numpy as np
import pandas as pd
import pytest

from tom.studies.road import (
    CONTROLS,
    MAIN,
    MLE_RETURN_MAX,
    OTHERS,
    Case,
    CaseResult,
    acceptance,
    cases,
    controls,
    normalised,
    run_case,
    weight_figure,
    weight_rows,
)
from tom.studies.study import Row

TOM: Row = {
    "name": "tom",
    "seed": 0,
    "turn": 180.0,
    "road_ratio": 60.0,
    "road_share": 0.98,
    "error_expert": 0.08,
    "error_road": 0.1,
    "error_rocks": 1.4,
    "return_random": -130.0,
    "return_expert": -22.0,
    "planner_return": -18.0,
    "planner_success": 1.0,
    "sac_return": -19.0,
    "sac_success": 1.0,
}
MLE = dict(
    TOM,
    name="mle",
    road_ratio=1.0,
    road_share=0.3,
    error_expert=1.0,
    error_road=0.8,
    error_rocks=0.8,
    planner_return=-140.0,
    planner_success=0.0,
    sac_return=-150.0,
    sac_success=0.0,
)


def outcome(case: Case) -> Row:
    return run_case(case).outcome


def failed(tom: list[Row], mle: list[Row]) -> list[str]:
    rows = [dict(o, seed=i) for side in (tom, mle) for i, o in enumerate(side)]
    return [check["name"] for check in acceptance(rows) if not check["met"]]


def test_normalised_return_by_hand():
    assert normalised(TOM, -130.0) == 0
    assert normalised(TOM, -22.0) == 1
    assert normalised(TOM, -76.0) == pytest.approx(0.5)


def test_acceptance_passes_and_fails_where_it_says():
    assert failed([TOM] * 4, [MLE] * 4) == []
    stuck = dict(TOM, sac_return=-110.0, sac_success=0.0)
    assert failed([TOM, TOM, TOM, stuck], [MLE] * 4) == []  # three of four seeds will do
    assert failed([TOM, TOM, stuck, stuck], [MLE] * 4) == ["share of seeds where TOM drives (sac)"]
    slow = dict(TOM, planner_success=0.85)
    assert failed([slow] * 4, [MLE] * 4) == ["share of seeds where TOM drives (planner)"]
    low = dict(TOM, road_ratio=4.9)
    assert failed([TOM, TOM, TOM, low], [MLE] * 4) == ["weight ratio road / rocks, minimum"]
    blind = dict(TOM, error_expert=0.36)
    assert failed([blind] * 4, [MLE] * 4) == ["error on expert data over MLE's"]
    keen = dict(TOM, error_rocks=0.79)
    assert failed([keen] * 4, [MLE] * 4) == ["error on rocks over MLE's"]
    lucky = dict(MLE, sac_success=0.3)
    assert failed([TOM] * 4, [MLE, MLE, MLE, lucky]) == ["share of seeds where MLE does not (sac)"]


def test_controls_fail_where_the_claim_would_mean_nothing():
    good = [
        dict(TOM, name="labels swapped", road_ratio=0.8),
        dict(MLE, name="mle, mean-zero rocks", planner_return=-20.0, sac_return=-21.0),
        dict(TOM, name="pmac, expert last"),
        dict(MLE, name="pmac, expert first"),
    ]
    assert all(check["met"] for check in controls(good))
    bad = [
        dict(good[0], road_ratio=30.0),
        dict(good[1], planner_return=-140.0, sac_return=-140.0),
        dict(good[2], planner_success=0.0),
        dict(good[3], planner_success=1.0),
    ]
    assert not any(check["met"] for check in controls(bad))


def test_an_outcome_without_optimisation_stops_at_the_planner():
    case = replace(cases(MAIN, [0])[0], optimise=False)
    found = outcome(case)
    assert found["planner_return"] < -100
    assert found["sac_return"] != found["sac_return"]  # not measured
    assert found["return_random"] < -110 < -25 < found["return_expert"]


def test_the_planner_is_no_figure_of_a_learner_that_follows_the_value():
    case = next(c for c in cases(OTHERS, [0]) if c.name == "vagram")
    found = outcome(replace(case, optimise=False))
    # It drives the model of the first fit, whose weights are uniform: MLE's model.
    assert isnan(found["planner_return"])
    assert isnan(found["planner_success"])
    assert found["error_expert"] > 0.9


@pytest.mark.slow
def test_acceptance_on_seeds_that_nothing_was_tuned_on():
    outcomes = [outcome(case) for case in cases(MAIN, [4, 5, 6, 7])]
    failed = {check["name"] for check in acceptance(outcomes) if not check["met"]}
    # MLE's SAC on seed 5 ends above its bound with one matmul kernel and below it with another
    # (docs/road-and-rocks.md); it never arrives.
    assert failed <= {"share of seeds where MLE does not (sac)"}
    stuck = [o for o in outcomes if o["name"] == "mle"]
    assert [o["sac_success"] for o in stuck] == [0.0] * 4
    assert sum(normalised(o, o["sac_return"]) <= MLE_RETURN_MAX for o in stuck) >= 3


@pytest.mark.slow
def test_controls_on_seeds_that_nothing_was_tuned_on():
    outcomes = [outcome(case) for case in cases(CONTROLS, [4, 5])]
    failed = {check["name"] for check in controls(outcomes) if not check["met"]}
    # Seed 5 is the one of eight whose swapped labels come to more than 3 (docs/road-and-rocks.md).
    assert failed <= {"labels swapped: weight ratio, maximum"}


def test_the_weights_over_the_map():
    rng = np.random.default_rng(0)
    of = {
        name: CaseResult(
            {"seed": 0}, [], rng.random((500, 2), np.float32), rng.random(500, np.float32)
        )
        for name in ("MLE", "TOM")
    }
    weights = pd.DataFrame(weight_rows(of))
    names, count, mean = (weights[c].to_numpy() for c in ("learner", "transitions", "mean weight"))
    assert {name: count[names == name].sum() for name in ("MLE", "TOM")} == {"MLE": 500, "TOM": 500}
    found = np.average(mean[names == "TOM"], weights=count[names == "TOM"])
    assert found == pytest.approx(of["TOM"].weights.mean())
    assert len(weight_figure(of).axes) == 3
