"""What is said of the paper's claim follows from the numbers, for and against."""

from dataclasses import replace

from test_road_study import MLE, TOM

from tom.studies.progression import RISE, Finding
from tom.studies.verdicts import PAPER, progression, road, tabular

PAIRS = [replace(o, seed=seed) for o in (TOM, MLE) for seed in (0, 1, 2)]


def test_road_agrees_where_tom_wins_and_has_the_road():
    better, heavier = road(PAIRS, [])
    assert "on 3 of 3 seeds (median -19.0 against -150.0" in better
    assert better.endswith(": as the paper says.")
    assert heavier.endswith("share 0.98 against 0.30): as the paper says.")


def test_road_differs_where_mle_wins():
    turned = [replace(o, name={"tom": "mle", "mle": "tom"}[o.name]) for o in PAIRS]
    assert [line.split(": ")[-1] for line in road(turned, [])] == ["the paper says otherwise."] * 2
    once = [*PAIRS[:2], replace(PAIRS[2], sac_return=-151.0), *PAIRS[3:]]
    assert road(once, [])[0].endswith(": mostly as the paper says.")


def test_road_names_what_arrives_as_well_and_where_mle_is_enough():
    simple = replace(TOM, name="expert-only")
    lost = replace(MLE, name="footprint-only")
    flat = [replace(TOM, name="mle", turn=turn) for turn in (60.0, 0.0)]
    said = road([*PAIRS, simple, lost], [*flat, replace(MLE, turn=180.0), TOM])
    assert "expert-only arrive as well" in said[2]
    assert "footprint-only" not in said[2]
    assert "at 0, 60 degrees" in said[3]


def finding(quantity: str, value: float, learner: str = "tom") -> Finding:
    return Finding("hopper-s0", "exact", "own", learner, quantity, (value,), None)


def test_progression_judges_each_part_of_the_claim():
    numbers = [("random half", 0.2), ("Spearman, ordered half", -0.1), (RISE, 9.0)]
    low, grow, early = progression([finding(*one) for one in numbers])
    assert low == (
        "TOM's weights lie below the mean over the random half in 1 of 1 recordings (0.2): as the "
        "paper says."
    )
    assert grow.endswith("in 0 of 1 recordings (-0.1): the paper says otherwise.")
    assert early.endswith("(9): the paper says otherwise.")
    assert progression([finding(RISE, 8.0)])[0].endswith("(8): as the paper says.")
    assert progression([finding(RISE, 8.0, "pmac")]) == []


def test_tabular_says_what_the_papers_own_numbers_come_to():
    rows = [
        {"variant": "exact", "spearman": 0.99, "l1": 0.04},
        {"variant": PAPER, "spearman": 0.85, "l1": 0.31},
    ]
    first, second = tabular(rows)
    assert first.startswith(
        "The ratio is recovered as the paper says: exact, rank correlation 0.99"
    )
    assert "less near: paper, 1 sampled a', rank correlation 0.85, relative L1 error 0.31" in second
    assert "not recovered" in tabular([{**rows[0], "spearman": 0.9}])[0]
