"""Answer: its three sentences hold the numbers that the runs' files give, computed another way."""

import json
import re
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from studio_pages import Show, array, draw, figures, plain, trace

import tom
from tom.analysis import answer
from tom.analysis.answer import QUESTIONS, Contrast, Side
from tom.analysis.curves import Curve
from tom.cli import main
from tom.envs import ENVS
from tom.errors import BAD_INPUT
from tom.record.decode import Profiles
from tom.record.files import read_json_lines

RUNS = Path(__file__).parents[3] / "runs"


def largest_group(learner: str, preset: str) -> list[Path]:
    """The gallery's runs of Hopper, fully weighted, whose models are alike, of most such runs."""
    alike: dict[int, list[Path]] = {}
    for path in sorted(RUNS.glob(f"hopper-{learner}-s*")):
        config = json.loads((path / "config.json").read_text())["config"]
        shares = [config[part].get("uniform_share", 0) for part in ("model", "rollout")]
        if config["preset"] == preset and not any(shares):
            alike.setdefault(config["model"]["hidden"], []).append(path)
    return max(alike.values(), key=len)


@pytest.fixture(scope="module")
def groups() -> tuple[list[Path], list[Path]]:
    return largest_group("tom", "mended"), largest_group("mle", "paper")


def lines(path: Path, name: str) -> list[dict]:
    return read_json_lines(path / name)[0]


def at(step: float, curve: list[tuple[int, float]]) -> float:
    """The value of a curve at a step."""
    steps, values = np.array(curve).T
    return float(np.interp(step, steps, values))


@pytest.fixture
def sentences(show: Show) -> list[str]:
    show(RUNS)
    return [plain(one.value) for one in draw("answer", task="hopper").markdown]


def test_the_share_of_the_newest_fifth_is_that_of_the_files(groups, sentences):
    weighing, _ = groups
    shares, left = [], []
    for path in weighing:
        last = lines(path, "weights/profiles.jsonl")[-1]
        bins = np.array(last["bins"])
        shares.append(bins[-len(bins) // 5 :].sum() / bins.sum())
        left.append(last["ess"])
    told = next(words for words in sentences if "newest fifth" in words)
    assert f"**{100 * np.mean(shares):.0f} %**" in told
    assert f"{100 * np.mean(left):.0f} % of the rows" in told


def test_the_footprint_is_the_middle_of_the_runs_medians(groups, sentences):
    weighing, _ = groups
    since = max(
        next(row["env_step"] for row in lines(p, "metrics.jsonl") if row.get("weights/ess", 1) < 1)
        for p in weighing
    )
    medians = []
    for path in weighing:
        of_fits = [
            row["exam/footprint"]
            for row in lines(path, "metrics.jsonl")
            if abs(row.get("exam/footprint_noise", 9)) < 1
            and row["env_step"] >= since
            and "exam/footprint" in row
        ]
        medians.append(np.median(of_fits))
    medians.sort()
    cut = len(medians) // 4
    middle = np.mean(medians[cut : len(medians) - cut])
    told = next(words for words in sentences if "distance to what the policy" in words)
    assert f"**{100 * middle:.0f} %**" in told


def test_returns_and_wins_are_those_of_all_pairs_and_p_of_all_arrangements(groups, sentences):
    ends = []
    for paths in groups:
        curves = [
            [(row["env_step"], row["eval/return"]) for row in lines(p, "metrics.jsonl")
             if "eval/return" in row] for p in paths
        ]  # fmt: skip
        ends.append(curves)
    until = min(curve[-1][0] for curves in ends for curve in curves)
    ours, theirs = ([at(until, c) for c in curves] for curves in ends)

    def wins(first: list[float], second: list[float]) -> float:
        return float(np.mean([(a > b) + 0.5 * (a == b) for a in first for b in second]))

    together = [*ours, *theirs]
    away = []
    for chosen in combinations(range(len(together)), len(ours)):
        first = [together[i] for i in chosen]
        second = [x for i, x in enumerate(together) if i not in chosen]
        away.append(abs(wins(first, second) - 0.5))
    p = np.mean(np.array(away) >= abs(wins(ours, theirs) - 0.5) - 1e-9)
    told = next(words for words in sentences if "a random run" in words)
    assert f"**{np.mean(ours):,.1f}**" in told
    assert f"**{np.mean(theirs):,.1f}**" in told
    assert f"{10 * wins(ours, theirs):.0f} times in 10 (p {p:.2g}" in told


def test_the_weight_is_where_it_goes_most_with_a_dimension(groups, sentences):
    told = next(words for words in sentences if "newest fifth" in words)
    seed = told.partition("(seed ")[2].partition(",")[0]
    [path] = [
        path for path in groups[0] if f"-s{seed}-" in path.name and (path / "buffer").is_dir()
    ]
    run = tom.load(path.name, store=RUNS)
    rows = run.rows()
    log = np.log2(np.maximum(rows["weight"] / rows["weight"].mean(), 1 / 32))
    among = rows.filter(regex="^(obs|action|next_obs)_").corrwith(log)
    column = among.abs().idxmax()
    name = ENVS["hopper"].obs_names[int(column.rpartition("_")[2])]
    assert f"where {name} is {'higher' if among[column] > 0 else 'lower'}" in told


def test_no_part_stands_out_where_no_plane_explains_the_weights():
    seen = Contrast(0, 100, {"speed": 1}, 0.3)
    looks = [answer.where(replace(side([1.0]), contrast=replace(seen, explained=share))).sentence
             for share in (0.3, 0.05)]  # fmt: skip
    assert ["speed" in sentence for sentence in looks] == [True, False]


@pytest.mark.parametrize("task", ["hopper", "road-and-rocks"])
def test_the_terminal_says_what_the_page_says(
    task: str, show: Show, capsys: pytest.CaptureFixture[str]
):
    show(RUNS)
    shown = [plain(one.value) for one in draw("answer", task=task).markdown]
    said = [re.sub(r"\[([^]]+)\]\(glossary[^)]*\)", r"\1", words) for words in shown]
    assert main(["answer", "--store", str(RUNS), "--env", task, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert list(told["answers"]) == list(QUESTIONS)
    for found in told["answers"].values():
        assert any(words.endswith(found["verdict"]) for words in said)
        assert found["sentence"] in said
    assert main(["answer", "--store", str(RUNS), "--env", task, "--one", "no group"]) == BAD_INPUT


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


def test_road_and_rocks_has_the_map_of_a_run_that_keeps_its_rows(show: Show):
    show(RUNS)
    cells = array(trace(figures(draw("answer", task="road-and-rocks"))[0], type="heatmap")["z"])
    kept = [path.parent for path in sorted(RUNS.glob("road-and-rocks-tom-s*/buffer"))]
    rows = tom.load(kept[-1].name, store=RUNS).rows()
    edges = np.linspace(0, 1, len(cells) + 1)
    y, x = (np.clip(rows[f"obs_{i}"].to_numpy(), 0, 1 - 1e-9) for i in (1, 0))
    count = np.histogram2d(y, x, (edges, edges))[0]
    weight = np.histogram2d(y, x, (edges, edges), weights=rows["weight"].to_numpy())[0]
    known = (count > 0) & (weight > 0)
    octaves = np.clip(np.log2(weight[known] / count[known]), -4, 4)  # the ends of its scale
    assert cells[known] == pytest.approx(octaves, abs=0.02)


def test_a_learner_that_weighs_alike_looks_nowhere_and_has_no_footprint():
    alike = side([1.0], uniform=True)
    assert (answer.where(alike).word, answer.on_policy(alike).word) == ("unclear", "unclear")


def test_without_exams_the_policys_place_is_unknown():
    assert answer.on_policy(side([1.0, 2.0])).word == "unknown"
