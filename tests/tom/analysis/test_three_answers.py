"""The three answers of groups whose runs' data are known."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from tom.analysis import answer
from tom.analysis.answer import Contrast, Side
from tom.analysis.curves import Curve
from tom.analysis.exams import Exams
from tom.record.decode import Profiles


def side(returns: list[float], newest: float = 0.5, *, uniform: bool = False) -> Side:
    """A group whose runs end at these returns, with a share of the weight on the newest fifth."""
    bins = np.array([[5 * (1 - newest) / 4] * 4 + [5 * newest]])
    fit = np.array([100])
    profiles = Profiles(fit, bins, fit, np.array([0.5]), np.array([0.0]), fit)
    curves = [
        Curve(str(i), "hopper", "tom", "paper", i, np.array([100]), np.array([value]))
        for i, value in enumerate(returns)
    ]
    return Side(
        "ours", "hopper", uniform, False, [profiles] * len(returns), curves, (), (), -np.inf, None
    )


def test_no_part_stands_out_where_no_plane_explains_the_weights():
    seen = Contrast(0, 100, {"speed": 1}, 0.3)
    looks = [answer.where(replace(side([1.0]), contrast=replace(seen, explained=share))).sentence
             for share in (0.3, 0.05)]  # fmt: skip
    assert ["speed" in sentence for sentence in looks] == [True, False]


def test_five_seeds_that_all_win_help_and_four_cannot_tell():
    high, low = [10.0, 11, 12, 13, 14], [1.0, 2, 3, 4, 5]
    assert answer.helps(side(high), side(low)).word == "yes"
    assert answer.helps(side(low), side(high)).word == "no"
    assert answer.helps(side(high), side(high)).word == "unclear"
    assert answer.helps(side(high[:4]), side(low)).word == "unknown"


def test_a_run_that_has_just_begun_changes_no_comparison():
    ours, theirs = side([10.0, 11, 12, 13, 14]), side([1.0, 2, 3, 4, 5])
    new = Curve("new", "hopper", "tom", "paper", 5, np.array([10]), np.array([0.0]))
    more = answer.helps(replace(ours, returns=[*ours.returns, new]), theirs)
    assert more == answer.helps(ours, theirs)


def test_one_run_far_from_the_others_does_not_turn_the_numbers_against_the_verdict():
    ours, theirs = side([11.0, 12, 13, 14, 15, 16, 17, 18]), side([3.0, 4, 5, 6, 7, 8, 9, 90])
    found = answer.helps(ours, theirs)
    assert found.word == "yes"
    assert "**14.5**" in found.sentence
    assert "**6.5**" in found.sentence


def test_what_three_scores_of_few_seeds_could_show_by_chance_is_no_yes():
    """Of 252 arrangements of five and five 8 are as far from a half as 23 wins of 25: p .032."""
    ours, theirs = [5.0, 7, 8, 9, 10], [1.0, 2, 3, 6, 6.5]
    found = answer.helps(side(ours), side(theirs))
    assert found.word == "unclear"
    assert "p 0.032" in found.sentence
    assert "0.095" in found.more


@pytest.mark.parametrize(("newest", "word"), [(0.6, "yes"), (0.05, "no"), (0.2, "unclear")])
def test_where_it_looks(newest: float, word: str):
    assert answer.where(side([1.0, 2.0], newest)).word == word


@pytest.mark.parametrize(("ratio", "word"), [(88.0, "yes"), (np.nan, "yes"), (0.5, "no")])
def test_road_and_rocks_has_a_road_and_no_age(ratio: float, word: str):
    frame = pd.DataFrame({"weights/road_share": [0.99, np.nan], "weights/road_ratio": [ratio, 1]})
    found = answer.where(replace(side([]), env="road-and-rocks", metrics=[frame, frame]))
    assert found.word == word
    assert "99 %" in found.sentence
    assert ("88" in found.sentence) == (ratio == 88)


def test_a_learner_that_weighs_alike_looks_nowhere_and_has_no_footprint():
    alike = side([1.0], uniform=True)
    assert (answer.where(alike).word, answer.on_policy(alike).word) == ("unclear", "unclear")


def test_without_exams_the_policys_place_is_unknown():
    assert answer.on_policy(side([1.0, 2.0])).word == "unknown"


def footprints(*of_runs: float) -> Side:
    """A group whose runs have one exam each, with these footprints."""
    known, none = np.zeros(1), np.full(1, np.nan)
    exams = [
        Exams(str(i), "tom", i, "ours", np.array([100]), none, none, np.full(1, one), known, none)
        for i, one in enumerate(of_runs)
    ]
    return replace(side([1.0] * len(exams)), exams=exams)


def test_footprints_of_as_few_runs_as_chance_often_puts_on_one_side_tell_nothing():
    assert answer.on_policy(footprints(0.9, 0.8)).word == "unknown"
    assert "85" in answer.on_policy(footprints(0.9, 0.8)).sentence
    nearer = [0.9, 0.8, 0.85, 0.95, 0.9]
    assert answer.on_policy(footprints(*nearer)).word == "yes"
    assert answer.on_policy(footprints(*(2 - one for one in nearer))).word == "no"
    assert answer.on_policy(footprints(*nearer[:3], 1.1, 1.2)).word == "unclear"
