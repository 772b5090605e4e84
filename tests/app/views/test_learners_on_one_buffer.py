"""Every learner on one buffer: stored weighings of a run's buffer, and how they are made."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from studio_pages import Show, array, captions, draw, figures, on_one_buffer, plain, trace
from studio_runs import PENDULUM_TOM, info, with_weighing

from app.data import buffer, weighings
from app.views.attention.learners import nearest
from tom.analysis.progression import progression
from tom.analysis.weighing import RANDOM
from tom.cli import main
from tom.record.reader import RunReader
from tom.reports.weighing_files import REPORT

pytestmark = pytest.mark.usefixtures("weighed")
ROWS = 400


@pytest.fixture(scope="module")
def results(store: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A real weighing of the pendulum's buffer, small."""
    out = tmp_path_factory.mktemp("probe") / "made"
    words = [
        "weigh", PENDULUM_TOM, "--policy", PENDULUM_TOM, "--learner", "tom", "pmac", "mle",
        "--seeds", "0", "1", "--preset", "paper", "--footprint", "100", "--store", str(store),
        "--tom.discriminator-steps", "30", "--tom.q-steps", "30", "--tom.q-hidden", "32",
        "--tom.discriminator-hidden", "32", "--matmul", "default", "--out", str(out),
    ]  # fmt: skip
    assert main(words) == 0
    return out


@pytest.fixture
def weighed(store: Path, results: Path, tmp_path: Path, show: Show) -> Path:
    """The studio shows a store with that weighing."""
    there = with_weighing(store, results, tmp_path)
    show(there)
    return there / "weighings" / "made"


def test_a_weighing_is_found_by_its_run(weighed: Path) -> None:
    run = info(weighed.parents[1], PENDULUM_TOM)
    (found,) = weighings.of_run(run)
    assert (found.name, found.report["policy"], found.missing(ROWS)) == ("made", PENDULUM_TOM, "")
    assert "tom.q_steps 30" in found.settings
    assert weighings.of_run(info(weighed.parents[1], "pendulum-mle-0")) == []
    of_step = replace(found, path=weighed.parent / "early", report={**found.report, "step": 1200})
    assert "1,200" in weighings.titles([found, of_step])["early"]
    twin = replace(found, path=weighed.parent / "twin")
    assert len({*weighings.titles([found, twin]).values()}) == 2
    table = pd.read_parquet(weighed / "weights.parquet")
    of = found.weights()
    assert set(of) == {(name, seed) for name in ("tom", "pmac", "mle") for seed in (0, 1)}
    assert of["tom", 1] == pytest.approx(table["tom-s1"].to_numpy())


def test_all_learners_lie_over_one_buffer_with_the_reports_numbers(weighed: Path) -> None:
    app = on_one_buffer(run=PENDULUM_TOM)
    report = json.loads((weighed / REPORT).read_text())
    table = pd.read_csv(weighed / "profile.csv")
    shown = app.dataframe[0].value.set_index("learner")
    for learner, label in (("tom", "TOM"), ("pmac", "PMAC"), ("mle", "MLE")):
        line = trace(figures(app)[0], meta=learner)
        of = table[table["learner"] == learner].groupby("bin")["mean_weight"]
        assert array(line["y"]) == pytest.approx(np.array(of.median()), rel=1e-3, abs=1e-5)
        medians, row = report["medians"][learner], shown.loc[label]
        assert [row["weight 0"], row["trend"], row["ESS"]] == [
            medians[name] for name in ("zeros", "spearman", "ess")
        ]
    split = figures(app)[0]["layout"]["shapes"][1]
    assert split["x0"] == pytest.approx(100 * report["ordered_from"] / ROWS)
    weights = pd.read_parquet(weighed / "weights.parquet")
    expected = [
        progression(weights[f"tom-s{s}"].to_numpy(), report["ordered_from"]) for s in (0, 1)
    ]
    assert shown.loc["TOM", "ESS"] == pytest.approx(np.median([one["ess"] for one in expected]))
    assert shown.loc["MLE", "random"] == pytest.approx(1)
    of_tom = [result for result in report["results"] if result["learner"] == "tom"]
    value, error = (
        np.median([result[name] for result in of_tom]) for name in ("footprint", "footprint_se")
    )
    assert shown.loc["TOM", "footprint"] == f"{value:.2f} ± {error:.2f}"
    assert shown.loc["MLE", "footprint"].startswith("1.00")  # the buffer without weights
    for result in report["results"]:
        result["footprint_se"] = None  # of fewer than five episodes
    (weighed / REPORT).write_text(json.dumps(report))
    shown = on_one_buffer(run=PENDULUM_TOM).dataframe[0].value.set_index("learner")
    assert shown.loc["TOM", "footprint"].startswith(f"{value:.2f}")


def test_a_weighing_of_a_run_that_went_on_is_of_its_first_rows(weighed: Path) -> None:
    for segment in sorted((weighed.parents[1] / PENDULUM_TOM / "buffer").glob("*.npz")):
        shutil.copy(segment, segment.with_name(f"{int(segment.stem) + ROWS:09d}.npz"))
    app = on_one_buffer(run=PENDULUM_TOM)
    assert trace(figures(app)[0], meta="tom")
    assert any(f"first {ROWS} of now {2 * ROWS} trans" in words.value for words in app.caption)
    run = info(weighed.parents[1], PENDULUM_TOM)
    [found] = weighings.of_run(run)
    rows = buffer.weighed_rows(run, found.weights()["tom", 0], found.end)
    assert rows is not None
    assert (rows.first, len(rows)) == (0, ROWS)


@pytest.mark.parametrize(
    "words",
    [
        {"part": "Every learner on one buffer"},
        {"weights": "TOM s1, made"},
    ],
)
def test_what_the_learners_noticed_stands_beside_their_weights(
    words: dict[str, str], weighed: Path
) -> None:
    assert not draw("attention", run=PENDULUM_TOM, **words).warning
    report = json.loads((weighed / REPORT).read_text())
    of_tom = [result for result in report["results"] if result["learner"] == "tom"]
    for result in of_tom:
        result["notices"] = ["no trust in this"]
    (weighed / REPORT).write_text(json.dumps(report))
    (said,) = draw("attention", run=PENDULUM_TOM, **words).warning
    assert "no trust in this" in said.value
    assert "TOM" in said.value


def test_every_learner_on_the_buffer_of_a_fit(weighed: Path) -> None:
    there = weighed.parents[1]
    step = RunReader(there / PENDULUM_TOM).policy_steps()[1]
    asked = on_one_buffer(run=PENDULUM_TOM, at=str(step))
    typed = f"--policy {PENDULUM_TOM} --step {step} "
    assert any(typed in code.value for code in asked.code)
    assert asked.selectbox(key="weigh policy").value == PENDULUM_TOM

    words = [
        "weigh", PENDULUM_TOM, "--policy", PENDULUM_TOM, "--step", str(step), "--seeds", "0",
        "--learner", "pmac", "vagram", "--footprint", "50", "--matmul", "default",
    ]  # fmt: skip
    assert main([*words, "--store", str(there)]) == 0
    made = next((there / "weighings").glob(f"*-at-{step}-*"))
    profile = pd.read_csv(made / "profile.csv").set_index(["learner", "bin"])["mean_weight"]
    app = on_one_buffer(run=PENDULUM_TOM, weighed=made.name)
    for learner in ("pmac", "vagram"):
        line = array(trace(figures(app)[0], meta=learner)["y"])
        assert line == pytest.approx(np.asarray(profile[learner]), rel=1e-3)
    assert f"{step} transitions" in captions(app)


def test_the_policy_is_the_buffers_own_until_another_is_chosen(weighed: Path) -> None:
    app = on_one_buffer(run=PENDULUM_TOM)
    for run_id in ("pendulum-tom-1", PENDULUM_TOM):
        app.session_state["run"] = [run_id]
        assert app.run().selectbox(key="weigh policy").value == run_id
    app.selectbox(key="weigh policy").select(RANDOM).run()
    app.session_state["run"] = ["pendulum-tom-1"]
    assert app.run().selectbox(key="weigh policy").value == RANDOM


def test_the_learner_named_nearest_is_that_of_the_least_median_footprint(weighed: Path) -> None:
    report = json.loads((weighed / REPORT).read_text())
    of: dict[str, list[float]] = {}
    for result in report["results"]:
        of.setdefault(result["learner"].upper(), []).append(result["footprint"])
    ordered = sorted(of, key=lambda name: np.median(of[name]))
    sentence = on_one_buffer(run=PENDULUM_TOM).markdown
    told = next(plain(one.value) for one in sentence if one.value.startswith(f"**{ordered[0]} "))
    for name in ordered[:2]:
        assert f"{100 * np.median(of[name]):.0f} %" in told
    assert f"at most {100 * max(map(np.ptp, of.values())):.0f} %" in told


def test_a_gap_counts_if_it_is_wider_than_seeds_of_one_learner_differ() -> None:
    near, far = np.array([0.5, 0.52, np.nan]), np.array([0.9, 0.95])
    assert " is more than " in nearest({"tom": near, "mle": far})
    assert " is no more than " in nearest({"tom": near, "mle": far, "pmac": np.array([0.1, 0.6])})
    one = nearest({"tom": near[:1], "mle": far[:1]})  # a single seed differs from none
    assert "50 %" in one
    assert " 0 %" not in one
    assert "more than" not in one
    assert "at most 2 %" in nearest({"tom": near, "mle": far[:1]})  # of those with two seeds
    assert nearest({"tom": near}) == nearest({"tom": near, "mle": far * np.nan}) == ""
