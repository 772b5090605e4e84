"""docs/findings.md: its tables are those of the gallery's studies and runs."""

import re
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from tom.analysis.scores import BEST, FINAL, HEIGHT
from tom.record import Store
from tom.studies import capacity, footprint
from tom.studies.frozen import MODELS, Outcome
from tom.studies.frozen_table import read_outcomes
from tom.studies.returns import Cell, compared_from, select
from tom.studies.returns_factors import factors
from tom.studies.returns_fits import EXAMS, exams, less, rollouts
from tom.studies.returns_tables import improvement, summary

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs/findings.md").read_text()
EXAMS_PAGE = (ROOT / "docs/exams.md").read_text()
FOUR = (0, 1, 2, 3)
SMALL = "model.hidden 8"
MODEL_ALONE, STARTS_ALONE = (
    f"TOM, mended, {place}.uniform_share 1.0" for place in ("rollout", "model")
)
WEIGHTS = {
    "tom-discounted": "TOM as printed",
    "tom-mended": "`mended`",
    "half-tom-mended": "half `mended`, half uniform",
    "half-recency": "half recency, half uniform",
}
MEASURES = ("area under the curve", "best return", "last return")


def rows(head: str, page: str = PAGE) -> list[list[str]]:
    """The cells of the page's table whose heading begins with `head`, without the heading."""
    (body,) = re.findall(rf"^\| {re.escape(head)}.*\n\|[-|]+\|\n((?:\|.*\n)+)", page, re.MULTILINE)
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in body.splitlines()]


@cache
def cells(
    at: int,
    *learners: str,
    seeds: tuple[int, ...] = (),
    apart: bool = False,
    env: str = "hopper",
) -> list[Cell]:
    """A task's runs as `tom reproduce returns --preset paper mended` compares them."""
    runs = [
        run
        for run in Store(ROOT / "runs").runs()
        if run.env == env and run.learner in learners and (not seeds or run.seed in seeds)
    ]
    return select(runs, "paper", "mended", at={env: at}, apart=apart)[0]


def share(value: float) -> str:
    """.92, or 1."""
    return f"{value:.2f}".removeprefix("0").replace("1.00", "1")


def spread(row: dict[str, Any], name: str, low: str, high: str, form: str = ".0f") -> str:
    """The value with its interval, where there is one."""
    value, *ends = (f"{row[key]:{form}}".removeprefix("0") for key in (name, low, high))
    return f"{value} [{', '.join(ends)}]" if "nan" not in ends else value


def whole(text: Any) -> str:
    return ", ".join(f"{value:.0f}" for value in text)


def measured(study: str) -> list[Outcome]:
    """The gallery's moments of a study on frozen buffers."""
    return read_outcomes(ROOT / "runs/studies" / study / "moments.csv", study == "capacity")


def signed(row: dict[str, Any]) -> str:
    """-.05 [-.10, +.00]"""
    value, *ends = (f"{row[key]:+.2f}".replace("0", "", 1) for key in ("difference", "low", "high"))
    return f"{value} [{', '.join(ends)}]"


def test_where_the_weights_lie() -> None:
    columns = ("hopper", "walker2d", "halfcheetah", "ess", "ends over policy's")
    made = {
        row["way"]: [
            f"{row['distance']:.2f}",
            f"{row['low']:.2f} to {row['high']:.2f}",
            *(f"{row[name]:.2f}" for name in columns),
        ]
        for row in footprint.summary(measured("footprint"))
    }
    assert {way: told for way, *told in rows("way")} == made


def test_two_ways_at_the_same_moments() -> None:
    made = {
        f"`{row['way']}`, `{row['against']}`": [
            signed(row),
            f"{row['nearer at']} of {row['n']}",
            f"{row['better on']} of {row['recordings']}",
            share(row["p"]),
        ]
        for row in footprint.head_to_head(measured("footprint"))
    }
    assert {ways: told for _, ways, *told in rows("question | first")} == made


def test_what_weights_do_for_models_of_each_size() -> None:
    made: dict[str, list[str]] = {name: [] for name in WEIGHTS.values()}
    for row in capacity.head_to_head(measured("capacity")):
        if row["against"] == footprint.UNIFORM:
            ratio, *ends = (f"{row[key]:.2f}".removeprefix("0") for key in ("ratio", "low", "high"))
            less = f"{row['less at']} of {row['n']} p {share(row['p'])}"
            made[WEIGHTS[row["way"]]].append(f"{ratio} [{', '.join(ends)}] {less}")
    assert {name: told for name, *told in rows("weights | linear")} == made
    assert all(len(told) == len(MODELS) for told in made.values())
    after: dict[str, list[str]] = {name: [] for name in WEIGHTS.values()}
    for row in capacity.summary(measured("capacity")):
        if row["way"] in WEIGHTS:
            below = round(row["five steps, below 1"] * row["n"])
            told = f"{row['five steps']:.2f}".removeprefix("0")
            after[WEIGHTS[row["way"]]].append(f"{told} {below} of {row['n']}")
    assert {name: told for name, *told in rows("weights, five steps ahead")} == after


def test_what_weights_do_for_the_papers_model_goes_by_the_robot() -> None:
    made = {
        WEIGHTS[row["way"]]: [share(row[env]) for env in ("hopper", "walker2d", "halfcheetah")]
        for row in capacity.head_to_head(measured("capacity"))
        if (row["against"], row["model"]) == (footprint.UNIFORM, "200 x 4")
    }
    assert {name: told for name, *told in rows("weights, 200 units, by robot")} == made


def test_the_scores_at_the_planned_end() -> None:
    made = scored(cells(40000, "mle", "pmac", "tom", "vagram"), 40000)
    assert {label: told for label, *told in rows("Hopper, step 40 000")} == made


@pytest.mark.parametrize(
    ("env", "name"), [("walker2d", "Walker2d"), ("halfcheetah", "HalfCheetah")]
)
def test_what_other_robots_returned_and_how_they_passed_their_exams(env: str, name: str) -> None:
    mine = cells(15000, "mle", "tom", env=env)
    made, exam = scored(mine, 15000), passed(mine)
    for row in rollouts(mine):  # of a robot that falls
        exam[row["learner"]].append(spread(row, "falls", "falls low", "falls high", ".2f"))
    assert {label: told for label, *told in rows(f"{name}, step 15 000")} == made
    assert {label: told for label, *told in rows(f"{name}, exams")} == exam


def test_the_scores_of_the_two_by_two() -> None:
    made = scored(two_by_two(), 40000)
    assert {label: told for label, *told in rows("Hopper, 2 x 2")} == made


def test_the_exams_of_the_two_by_two() -> None:
    made = passed(two_by_two())
    for row in rollouts(two_by_two()):
        made[row["learner"]].append(spread(row, "falls", "falls low", "falls high", ".2f"))
    assert {label: told for label, *told in rows("exams of the 2 x 2")} == made


def test_whether_the_starts_alone_beat_the_model_alone() -> None:
    """Of the cells as the command has them, whose p's are not those of fewer."""
    mine = cells(40000, "mle", "tom", seeds=FOUR, apart=True)
    pair = (MODEL_ALONE, STARTS_ALONE)
    (area,) = (
        row
        for row in improvement(mine)
        if (row["learner"], row["against"]) == pair and row["by"] == MEASURES[0]
    )
    wins, low, high = (share(1 - area[key]) for key in ("wins", "high", "low"))
    assert f"with {wins} [{low}, {high}] by area (p {share(area['p'])})" in PAGE
    against_mle = {
        row["learner"]: f"{spread(row, 'wins', 'low', 'high', '.2f')} (p {share(row['p'])})"
        for row in improvement(mine)
        if row["against"] == "MLE" and row["by"] == MEASURES[0]
    }
    for told, cell in {
        "starts alone beat MLE with": STARTS_ALONE,
        "a weighted model alone with": MODEL_ALONE,
        "`mended` with": "TOM, mended",
    }.items():
        assert f"{told} {against_mle[cell].replace('1.00', '1')}" in " ".join(PAGE.split())
    p = {row["in"]: row for row in less(mine) if (row["learner"], row["against"]) == pair}
    told = [share(p[name]["p"]) for name in ("error", "error after 5 steps")]
    assert f"starts alone .19 and .56 (p {told[0]} and {told[1]})" in " ".join(PAGE.split())
    assert all(row["p of all"] == 1 for row in p.values())


def two_by_two() -> list[Cell]:
    """MLE, `mended`, and `mended` with weights in one place alone."""
    mine = cells(40000, "mle", "tom", seeds=FOUR, apart=True)
    return [cell for cell in mine if cell.label != "TOM"]


def test_what_runs_with_a_small_model_returned_and_how_they_passed_their_exams() -> None:
    mine = cells(20000, "mle", "tom", seeds=FOUR, apart=True)
    areas, exam = scored(mine, 20000), passed(mine)
    falls = {
        row["learner"]: spread(row, "falls", "falls low", "falls high", ".2f")
        for row in rollouts(mine)
    }
    sizes = {"8 units, 2 layers": f", {SMALL}, model.layers 2", "the paper's": ""}
    made = {
        f"{learner}, {size}": [
            *areas[learner + end],
            *exam[learner + end][:1],
            *exam[learner + end][2:],
            falls[learner + end],
        ]
        for size, end in sizes.items()
        for learner in ("MLE", "TOM, mended")
    }
    assert {label: told for label, *told in rows("Hopper, size of the model")} == made


def test_the_p_of_the_small_models_errors_is_by_permutation_of_their_medians() -> None:
    mine = cells(20000, "mle", "tom", seeds=FOUR, apart=True)
    small = [cell for cell in mine if SMALL in cell.label]
    for chosen in (mine, small):
        p = {
            row["in"]: share(row["p"])
            for row in less(chosen)
            if SMALL in row["learner"] and SMALL in row["against"]
        }
        told = f"p {p['error']} one step ahead, {p['error after 5 steps']} after five"
        assert told in PAGE
        assert f"MLE (p {p['error']})" in (ROOT / "README.md").read_text()


def test_how_often_mended_beats_mle_with_a_small_model() -> None:
    mine = {
        row["by"]: row
        for row in improvement(cells(20000, "mle", "tom", seeds=FOUR, apart=True))
        if SMALL in row["learner"] and SMALL in row["against"]
    }
    told = {by: words for by, *words in rows("TOM, mended, beats MLE: 8 units")}
    assert told == {
        by: [spread(row, "wins", "low", "high", ".2f"), share(row["p"])] for by, row in mine.items()
    }


@pytest.mark.parametrize("row", rows("effect, the mean"), ids=lambda row: row[0])
def test_the_effects_of_the_two_by_two(row: list[str]) -> None:
    place, *told = row
    made = factors(cells(40000, "mle", "tom", seeds=FOUR, apart=True))
    mine = {one["by"]: one for one in made if one["effect of"] == place}
    for i, by in enumerate(MEASURES):
        value, *ends = (f"{mine[by][key]:+.0f}" for key in ("effect", "low", "high"))
        effect = f"{value} [{', '.join(ends)}]"
        assert told[3 * i : 3 * i + 3] == [effect, *(share(mine[by][key]) for key in ("wins", "p"))]


def scored(mine: list[Cell], at: int) -> dict[str, list[str]]:
    """The areas with their interval and of each seed, and the best and last returns, by learner."""
    since = compared_from(mine)[mine[0].env]
    assert since == 6000
    return {
        cell.label: [
            spread(row, "area", "area low", "area high"),
            whole(cell.scores(at, HEIGHT, since)),
            whole(cell.scores(at, BEST)),
            whole(cell.scores(at, FINAL)),
        ]
        for cell, row in zip(mine, summary(mine), strict=True)
    }


def passed(mine: list[Cell], form: str = ".2f") -> dict[str, list[str]]:
    """The number of runs with exams, and what they say, by learner."""
    made = {
        row["learner"]: [
            str(row["n"]),
            *(spread(row, name, f"{name} low", f"{name} high", form) for name in EXAMS.values()),
        ]
        for row in exams(mine)
    }
    made["MLE"][1] = "1"  # by definition, so without an interval
    return made


def test_what_the_exams_of_the_inverted_pendulum_said() -> None:
    learners = ("mle", "pmac", "tom", "ratio", "vagram", "vagram-ensemble")
    mine = cells(2500, *learners, env="inverted-pendulum")
    assert {cell.reach for cell in mine} == {2500}
    made = passed(mine, ".2g")
    told = {label: said for label, *said in rows("learner | runs | footprint", EXAMS_PAGE)}
    assert told == made


@pytest.mark.parametrize("row", rows("TOM, mended beats MLE"), ids=lambda row: row[0])
def test_how_often_mended_beats_mle(row: list[str]) -> None:
    check_wins(row, "MLE")


@pytest.mark.parametrize("row", rows("TOM, mended beats TOM as printed"), ids=lambda row: row[0])
def test_how_often_mended_beats_tom_as_printed(row: list[str]) -> None:
    check_wins(row, "TOM")


def check_wins(row: list[str], against: str) -> None:
    """A line of the page's table of wins is what the gallery's runs give."""
    name, *told = row
    first, last, at = map(int, re.findall(r"\d+", name.replace(" 000", "000")))
    made = improvement(cells(at, "mle", "tom", seeds=tuple(range(first, last + 1))))
    mine = {
        one["by"]: one
        for one in made
        if (one["learner"], one["against"]) == ("TOM, mended", against)
    }
    for by, wins, p in zip(MEASURES, told[::2], told[1::2], strict=True):
        assert p == (share(mine[by]["p"]) if mine[by]["p"] >= 0.005 else "<.01")
        value, *ends = (share(mine[by][key]) for key in ("wins", "low", "high"))
        assert wins in (value, f"{value} [{', '.join(ends)}]")


def test_every_learner_with_six_seeds() -> None:
    mine = cells(20000, "mle", "pmac", "tom")
    made = passed(mine)
    for row in rollouts(mine):
        made[row["learner"]].append(spread(row, "falls", "falls low", "falls high", ".2f"))
    areas = {row["learner"]: spread(row, "area", "area low", "area high") for row in summary(mine)}
    told = {label: (area, tuple(rest)) for label, area, *rest in rows("Hopper, step 20 000")}
    assert told == {label: (areas[label], tuple(rest)) for label, rest in made.items()}
