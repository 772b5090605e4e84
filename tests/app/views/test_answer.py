"""Answer: its three sentences hold the numbers that the runs' files give, computed another way."""

import json
import re
import shutil
from itertools import combinations
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from studio_pages import Show, array, draw, figures, plain, trace

import tom
from tom.analysis.answer import QUESTIONS
from tom.cli import main
from tom.envs import ENVS
from tom.errors import BAD_INPUT
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


def middle(values: list[float]) -> float:
    """The mean without a quarter, rounded down, at each end."""
    cut = len(values) // 4
    return float(np.mean(sorted(values)[cut : len(values) - cut]))


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
    assert f"**{100 * middle(shares):.0f} %**" in told
    assert f"{100 * middle(left):.0f} % of the rows" in told


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
    told = next(words for words in sentences if "distance to what the policy" in words)
    assert f"**{100 * middle(medians):.0f} %**" in told


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
    assert f"**{middle(ours):,.1f}**" in told
    assert f"**{middle(theirs):,.1f}**" in told
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


def test_a_fit_whose_weights_are_written_anew_has_a_new_sentence(
    groups, tmp_path: Path, show: Show
):
    path = next(path for path in groups[0] if (path / "buffer").is_dir())
    shutil.copytree(path, tmp_path / path.name)
    show(tmp_path)

    def told() -> str:
        said = (plain(one.value) for one in draw("answer").markdown)
        return next(words for words in said if "newest fifth" in words)

    before = told()
    for snapshot in (tmp_path / path.name / "weights").glob("snapshot-*.parquet"):
        table = pd.read_parquet(snapshot)
        table[::-1].reset_index(drop=True).to_parquet(snapshot)
    assert told() != before


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
