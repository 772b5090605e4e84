"""Return curves of small recorded runs whose every return is known."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from common import measured

from tom.analysis.scores import ESS
from tom.envs import ENVS
from tom.record import Store
from tom.studies import returns_cells as study
from tom.studies import returns_tables as tables
from tom.studies.returns import in_sentences, return_figure


def record(
    store: Store,
    env: str,
    learner: str,
    seed: int,
    returns: Sequence[float],
    preset: str = "paper",
    **of: Any,
) -> None:
    """A run with these returns at steps 1 000, 2 000 and so on."""
    steps = [(1000 * i, {"eval/return": value}) for i, value in enumerate(returns, start=1)]
    run_id = store.new_run_id(env, learner, seed)
    measured(store, run_id, learner, seed, *steps, env=env, preset=preset, **of)


@pytest.fixture
def store(tmp_path: Path) -> Store:
    made = Store(tmp_path)
    record(made, "hopper", "tom", 0, [10, 30, 20, 90])
    record(made, "hopper", "tom", 1, [20, 50, 40])
    record(made, "hopper", "mle", 0, [40, 10, 10])
    record(made, "walker2d", "tom", 0, [1, 2])
    record(made, "walker2d", "mle", 0, [3, 2])
    return made


def test_a_run_for_each_seed_of_the_largest_group_of_settings(store: Store):
    record(store, "hopper", "tom", 1, [0])  # shorter than the other of this seed
    record(store, "hopper", "tom", 2, [9, 9, 9, 9], updates_per_step=7)
    record(store, "hopper", "mle", 5, [1], preset="smoke")
    cells, left_out = study.select(store.runs(), "paper")
    assert [(c.env, c.learner, c.seeds) for c in cells] == [
        ("hopper", "mle", [0]),
        ("hopper", "tom", [0, 1]),
        ("walker2d", "mle", [0]),
        ("walker2d", "tom", [0]),
    ]
    assert len(left_out) == 2


def test_runs_with_changed_settings_stand_beside_the_others_if_asked(store: Store):
    for seed in range(3):
        record(store, "hopper", "tom", seed, [7, 8, 9], updates_per_step=7)
    record(store, "hopper", "tom", 0, [5, 5, 5], preset="mended", updates_per_step=7)
    cells, left_out = study.select(store.runs(), "paper", "mended", apart=True)
    of_hopper = [cell for cell in cells if cell.env == "hopper"]
    assert {cell.label: cell.seeds for cell in of_hopper} == {
        "MLE": [0],
        "TOM": [0, 1],
        "TOM, updates_per_step 7": [0, 1, 2],
        "TOM, mended, updates_per_step 7": [0],
    }
    assert not left_out
    assert len(return_figure(of_hopper).axes) == 1
    assert any("differ in more than" in line for line in in_sentences(of_hopper))


def test_learners_are_compared_at_a_step_that_all_reach(store: Store):
    cells, _ = study.select(store.runs(), "paper")
    assert study.compared_at(cells) == {"hopper": 3000, "walker2d": 2000}
    rows = {(r["env"], r["learner"]): r for r in tables.summary(cells)}
    tom = rows["hopper", "TOM"]
    assert tom["mean"] == (30 + 50) / 2  # of the running maximum, not of what came after
    assert tom["n"] == 2
    assert "2 seeds are few" in tom["remark"]
    assert tom["steps to MLE's"] == np.inf  # of two runs one gets there, the other after step 3000
    assert tom["area"] == pytest.approx(np.mean([(20 + 25) / 2, (35 + 45) / 2]))
    assert np.isnan(rows["hopper", "MLE"]["low"])


def test_at_a_step_fixed_beforehand_shorter_runs_are_left_out_and_longer_ones_cut(store: Store):
    cells, left_out = study.select(store.runs(), "paper", at=dict.fromkeys(ENVS, 3000))
    assert study.compared_at(cells) == {"hopper": 3000}  # Walker2d's runs end at 2000
    assert len([run_id for run_id in left_out if run_id.startswith("walker2d")]) == 2
    assert max(cell.longest for cell in cells) == 3000
    assert {row["learner"]: row["mean"] for row in tables.summary(cells)} == {"MLE": 40, "TOM": 40}
    (alone,), short = study.select(store.runs(), "paper", at=dict.fromkeys(ENVS, 3001))
    assert (alone.learner, alone.seeds, len(short)) == ("tom", [0], 4)
    assert study.select(store.runs(), "paper", at=dict.fromkeys(ENVS, 4001))[0] == []


def test_of_one_seed_the_run_that_reaches_the_step_is_used(store: Store):
    record(store, "hopper", "mle", 0, [7] * 4, updates_per_step=7)
    cells, _ = study.select(store.runs(), "paper", at=dict.fromkeys(ENVS, 4000))
    assert [(cell.learner, list(cell.scores())) for cell in cells] == [
        ("mle", [7.0]),
        ("tom", [90.0]),
    ]


def test_wins_over_tasks_that_both_have(store: Store):
    cells, _ = study.select(store.runs(), "paper")
    best, last, area = tables.improvement(cells)
    # Hopper: 30 and 50 against 40: half; Walker2d: 2 against 3: none.
    assert best["wins"] == pytest.approx((0.5 + 0) / 2)
    assert best["tasks"] == "hopper walker2d"
    # 20 and 40 against 10: both; 2 against 2: half.
    assert last["by"] == "last return"
    assert last["wins"] == pytest.approx((1 + 0.5) / 2)
    # Mean heights 22.5 and 40 against 17.5: both; 1.5 against 2.5: none.
    assert area["by"] == "area under the curve"
    assert area["wins"] == pytest.approx((1 + 0) / 2)


def test_exams_are_the_median_fit_of_each_run_and_their_mean(store: Store):
    told = (
        [(0.5, 0.2, 1.0, 4.0), (0.7, -0.9, 3.0, 6.0), (0.9, 0.1, 2.0, 8.0), (80.0, 1.1, 2.0, 6.0)],
        [(0.1, 0.1, 4.0, 2.0)],
        [(7.0, 3.0, 3.0, 4.0)],
    )  # a footprint whose noise is 1 or more says nothing
    names = ("exam/footprint", "exam/footprint_noise", "exam/error", "exam/rollout_error")
    for seed, of_seed in enumerate(told):
        fits = [(step, dict(zip(names, fit, strict=True))) for step, fit in enumerate(of_seed, 1)]
        measured(store, f"examined-{seed}", "pmac", seed, *fits, (1000, {"eval/return": 1.0}))
    (row,) = tables.exams(study.select(store.runs(), "paper")[0])  # the others sat none
    assert (row["env"], row["learner"], row["n"]) == ("hopper", "PMAC", 3)
    assert row["footprint"] == pytest.approx((0.7 + 0.1) / 2)
    assert row["error"] == pytest.approx((2 + 4 + 3) / 3)
    assert row["error after 5 steps"] == pytest.approx((6 + 2 + 4) / 3)
    assert row["footprint low"] == pytest.approx(0.1)


def examined(store: Store, learner: str, seed: int, error: float, falls: float = np.nan) -> None:
    """A run of Hopper whose fits have this error and so many falls of rollouts for one real one."""
    exam = {"exam/footprint": 0.5, "exam/footprint_noise": 0.1, "exam/error": error}
    exam |= {"exam/rollout_error": 2 * error, tables.FALLS: 0.01 * falls, tables.POLICY_FALLS: 0.01}
    exam |= {tables.LARGEST: 1, tables.SIZE: 500}
    measured(store, f"{learner}-{seed}", learner, seed, (500, exam), (1000, {"eval/return": 1.0}))


def test_exams_are_compared_as_scores_are_and_less_is_less(tmp_path: Path):
    store = Store(tmp_path)
    for seed in range(4):
        examined(store, "mle", seed, 5 + seed, falls=seed)
        examined(store, "tom", seed, 1 + seed if seed else 7.5)  # less in 13 of 16 pairs
        examined(store, "pmac", seed, 9, falls=9)
    rows = tables.less(study.select(store.runs(), "paper")[0])
    pairs = [("PMAC", "MLE"), ("TOM", "MLE"), ("TOM", "PMAC")]
    named = {pair: [r for r in rows if (r["learner"], r["against"]) == pair] for pair in pairs}
    assert sum(map(len, named.values())) == len(rows) == 4 + 3 + 3  # TOM's rollouts fell never
    footprint, error, later = named["TOM", "MLE"]
    assert (footprint["in"], footprint["less"], footprint["p"]) == ("footprint", 0.5, 1)
    assert (error["in"], error["less"]) == ("error", 13 / 16)
    assert error["p"] == pytest.approx(14 / 70)  # of 70 arrangements 7 have 13 wins or more
    assert (later["in"], later["p"]) == ("error after 5 steps", error["p"])
    falls = named["PMAC", "MLE"][-1]
    assert (falls["in"], falls["less"]) == ("falls", 0)
    assert falls["p"] == pytest.approx(2 / 70)
    assert falls["p of all"] == pytest.approx(2 / 70 * 10)
    assert all("4 seeds are few" in row["remark"] for row in rows)
    chosen = [c for c in study.select(store.runs(), "paper")[0] if c.learner != "mle"]
    assert [row["in"] for row in tables.less(chosen)] == list(tables.EXAMS.values())


def test_fits_before_every_learner_weighs_do_not_count(store: Store):
    """TOM's first fits are as MLE's: with them its footprint would stand nearer to 1."""
    for learner, weighs_from in (("mle", 9000), ("pmac", 300), ("tom", 500)):
        fits = []
        for step in range(100, 901, 100):
            values = dict.fromkeys(tables.EXAMS, float(step)) | {tables.FALLS: 0.01 * step}
            values |= {tables.POLICY_FALLS: 0.01, tables.LARGEST: 1.0, tables.SIZE: 500.0}
            fits.append((step, values | {ESS: 0.5 if step >= weighs_from else 1.0}))
        measured(store, f"{learner}-5", learner, 5, *fits, (1000, {"eval/return": 1.0}))
    chosen, _ = study.select([run for run in store.runs() if run.seed == 5], "paper")
    assert {row["error"] for row in tables.exams(chosen)} == {700}  # of 500 to 900, MLE's too
    assert {row["falls"] for row in tables.rollouts(chosen)} == {700}
    alone = [cell for cell in chosen if cell.learner != "tom"]
    assert {row["error"] for row in tables.exams(alone)} == {600}


def test_rollouts_fall_so_often_as_the_policy_or_more(store: Store):
    told = (
        [(0.02, 0.01, 1.0), (0.03, 0.01, 50.0), (0.08, 0.01, 5.0), (0.5, 0.0, 900.0)],
        [(0.01, 0.02, 1.0)],
    )  # of the policy's last steps none ends in the fit with 0.0
    names = (tables.FALLS, tables.POLICY_FALLS, tables.LARGEST)
    late = {tables.FALLS: 9.0, tables.POLICY_FALLS: 0.01, tables.LARGEST: 1.0, tables.SIZE: 500.0}
    for seed, of_seed in enumerate(told):
        fits = [
            (step, {**dict(zip(names, fit, strict=True)), tables.SIZE: 500.0})
            for step, fit in enumerate(of_seed, 1)
        ]
        evaluated = (1000, {"eval/return": 1.0})  # the step of the comparison
        measured(store, f"rolled-{seed}", "pmac", seed, *fits, evaluated, (2000, late))
    (row,) = tables.rollouts(study.select(store.runs(), "paper")[0])  # the others recorded none
    assert (row["learner"], row["n"]) == ("PMAC", 2)
    assert row["falls"] == pytest.approx((3 + 0.5) / 2)
    assert row["heavy rows"] == pytest.approx((2 / 4 + 0) / 2)
    assert row["falls low"] == pytest.approx(0.5)


def test_learners_with_different_settings_are_not_ranked_without_a_remark(store: Store):
    record(store, "ant", "vagram-ensemble", 0, [1, 2])  # its preset has another model: no remark
    for learner in ("mle", "tom"):
        record(store, "ant", learner, 0, [1, 2])
        record(store, "halfcheetah", learner, 0, [1, 2], updates_per_step=7)  # both alike
    cells, _ = study.select(store.runs(), "paper")
    assert not [line for line in in_sentences(cells) if "differ" in line]
    record(store, "hopper", "mle", 0, [3, 3, 3, 3, 3], updates_per_step=7)
    record(store, "hopper", "mle", 1, [3, 3, 3, 3, 3], updates_per_step=7)
    cells, _ = study.select(store.runs(), "paper")
    (line,) = [line for line in in_sentences(cells) if "differ" in line]
    assert line.startswith("hopper: ")
    assert "(updates_per_step)" in line


def two_by_two(
    store: Store, preset: str, means: Sequence[float], seeds: int = 3, **changes: Any
) -> list[study.Cell]:
    """Cells with these means: TOM, that with uniform starts, with a uniform model, and MLE."""
    for uniform, mean in zip(("", "rollout", "model", "mle"), means, strict=True):
        learner = "mle" if uniform == "mle" else "tom"
        own = {uniform: {"uniform_share": 1.0}} if uniform in ("rollout", "model") else {}
        for seed in range(seeds):
            returns = [mean + seed - (seeds - 1) / 2] * 2
            shared = {name: of for name, of in changes.items() if (learner, name) != ("mle", "tom")}
            used = "paper" if (learner, preset) == ("mle", "mended") else preset
            record(store, "hopper", learner, seed, returns, used, **shared, **own)
    return study.select(store.runs(), "paper", preset, apart=True)[0]


def test_what_weights_do_is_asked_of_runs_that_are_alike_in_all_else(tmp_path: Path):
    store, other = Store(tmp_path / "a"), Store(tmp_path / "b")
    for seed in range(3):  # an MLE of another preset, or with other settings, is no part of it
        record(store, "hopper", "mle", seed, [100, 100])
        record(other, "hopper", "mle", seed, [100, 100])
    found = tables.factors(two_by_two(store, "mbpo", (11, 11, 11, 11)))
    assert {row["effect"] for row in found} == {0}
    assert {row["learner"] for row in found} == {"TOM, mbpo"}
    settings = {"fit_every": 500, "tom": {"q_steps": 500}}
    found = tables.factors(two_by_two(other, "mended", (11, 11, 11, 11), **settings))
    assert {row["effect"] for row in found} == {0}
    assert {row["learner"] for row in found} == {"TOM, mended, fit_every 500, tom.q_steps 500"}


def test_of_single_runs_an_effect_has_no_p(tmp_path: Path):
    found = tables.factors(two_by_two(Store(tmp_path), "mended", (51, 11, 21, 11), seeds=1))
    assert [row["effect"] for row in found[:3]] == [15, 25, 30]
    assert all(np.isnan(row["p"]) and np.isnan(row["low"]) for row in found)


def test_what_weights_do_in_either_place_is_the_mean_over_the_others_levels(tmp_path: Path):
    chosen = two_by_two(Store(tmp_path), "mended", (51, 11, 21, 11))
    rows = {(row["effect of"], row["by"]): row for row in tables.factors(chosen)}
    assert len(rows) == 3 * len(tables.MEASURES)
    area = "area under the curve"
    model, starts = rows["weighted model", area], rows["weighted starts", area]
    assert model["learner"] == "TOM, mended"
    assert model["effect"] == ((51 - 21) + (11 - 11)) / 2
    assert starts["effect"] == ((51 - 11) + (21 - 11)) / 2
    assert rows["both beyond their sum", area]["effect"] == 51 - 21 - 11 + 11
    assert model["low"] < model["effect"] < model["high"]
    assert model["wins"] == (1 + 0.5) / 2
    assert starts["wins"] == 1
    assert starts["p"] == pytest.approx(2 / 20**2, abs=0.002)  # 3 against 3, twice
    assert model["p of all"] >= model["p"]
    assert np.isnan(rows["both beyond their sum", area]["p"])
    assert not tables.factors([cell for cell in chosen if cell.learner != "mle"])
    assert not tables.factors([cell for cell in chosen if "rollout" not in cell.variant])
