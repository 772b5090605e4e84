"""`tom reproduce returns` on small runs that were trained for real."""

import json
from pathlib import Path

import pytest

from tom.cli import main
from tom.events import Metrics, Tick
from tom.record import Store
from tom.record.recorder import Recorder
from tom.record.writer import RunWriter
from tom.training.presets import resolve

TRAIN = ["train", "--env", "inverted-pendulum", "--preset", "smoke", "--no-rerun", "--steps", "250"]


def test_a_report_of_what_the_store_has(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    store, out = tmp_path / "store", tmp_path / "out"
    assert main([*TRAIN, "--learner", "mle", "--store", str(store)]) == 0
    capsys.readouterr()
    words = ["reproduce", "returns", "--store", str(store), "--out", str(out), "--preset", "smoke"]
    assert main([*words, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["summary"][0]["n"] == 1
    of_paper = {"MLE", "PMAC", "TOM", "Ratio", "VaGram (MDN)", "VaGram (Ensemble)"}
    assert {row["learner"] for row in found["missing"]} == of_paper
    assert {path.name for path in out.iterdir()} == {
        "returns.png", "returns.svg", "report.html", "report.json", "returns.csv", "summary.csv",
        "improvement.csv", "factors.csv", "exams.csv", "rollouts.csv", "less.csv", "missing.csv",
    }  # fmt: skip
    assert "tom sweep --env hopper" in (out / "report.html").read_text()
    assert main(words) == 0
    assert main([*words, "--at", "250"]) == 0
    assert main([*words, "--at", "inverted-pendulum=250"]) == 0
    capsys.readouterr()
    assert main([*words, "--at", "251", "--out", str(tmp_path / "none")]) == 2
    assert "ends at 250" in capsys.readouterr().err
    assert not (tmp_path / "none").exists()
    (out / "returns.csv").unlink()
    (out / "returns.csv").mkdir()
    assert main(words) == 1
    assert capsys.readouterr().err.count("\n") == 1


def test_who_is_left_out_is_named_where_the_table_is(tmp_path: Path, capsys):
    """Whoever ended early may have diverged: without it the table is of the survivors."""
    store = Store(tmp_path / "store")
    for run_id, last in (("whole", 200), ("short", 100)):
        config = resolve("inverted-pendulum", "mle", "smoke", {"seed": int(last == 100)})
        with Recorder(RunWriter.create(store, run_id, config)) as recorder:
            for step in range(100, last + 1, 100):
                recorder.consume(Metrics(step, {"eval/return": 1.0}))
                recorder.consume(Tick(step, "evaluate"))
    words = ["reproduce", "returns", "--store", str(store.path), "--preset", "smoke"]
    words += ["--out", str(tmp_path / "out")]
    assert main([*words, "--at", "200"]) == 0
    assert "--at: short." in capsys.readouterr().out
    assert main([*words, "--at", "200", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["left out"] == ["short"]
    assert main(words) == 0
    assert "Left out" not in capsys.readouterr().out


def test_seeds_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    store = Store(tmp_path / "store")
    for seed in range(3):
        config = resolve("inverted-pendulum", "mle", "smoke", {"seed": seed})
        with Recorder(RunWriter.create(store, f"seed-{seed}", config)) as recorder:
            recorder.consume(Metrics(100, {"eval/return": float(seed)}))
            recorder.consume(Tick(100, "evaluate"))
    words = ["reproduce", "returns", "--store", str(store.path), "--preset", "smoke", "--json"]
    words += ["--out", str(tmp_path / "out"), "--seeds"]
    assert main([*words, "1", "2"]) == 0
    found = json.loads(capsys.readouterr().out)
    (row,) = found["summary"]
    assert (row["seeds"], row["mean"], found["left out"]) == ("1 2", 1.5, [])
    RunWriter.create(store, "seed-9", resolve("inverted-pendulum", "mle", "smoke", {"seed": 9}))
    assert main([*words, "9"]) == 2
    assert "--seeds 9: no such run was evaluated" in capsys.readouterr().err
    assert main([*words, "3", "4"]) == 2
    assert "--seeds 3 4: no such run" in capsys.readouterr().err


def test_a_comparison_that_was_fixed_beforehand_is_corrected_for_no_other(tmp_path: Path, capsys):
    store = Store(tmp_path / "store")
    for place, (learner, preset) in enumerate(
        (("mle", "paper"), ("pmac", "paper"), ("tom", "paper"), ("tom", "mended"))
    ):
        for seed in range(4):
            config = resolve("hopper", learner, preset, {"seed": seed})
            with Recorder(RunWriter.create(store, f"{place}-{seed}", config)) as recorder:
                recorder.consume(Metrics(100, {"eval/return": 10.0 * place + seed}))
                recorder.consume(Tick(100, "evaluate"))
    words = ["reproduce", "returns", "--store", str(store.path), "--preset", "paper", "mended"]
    words += ["--out", str(tmp_path / "out"), "--json"]

    def compared(*chosen: str) -> list[dict]:
        assert main([*words, *chosen]) == 0
        return json.loads(capsys.readouterr().out)["improvement"]

    assert len(compared()) == 6 * 3
    of_two = compared("--groups", "TOM, mended", "MLE")
    assert {(row["learner"], row["against"]) for row in of_two} == {("TOM, mended", "MLE")}
    assert len(of_two) == 3
    by_compare = compared("--groups", "TOM, mended", "MLE, paper")  # as the page calls them
    assert by_compare == of_two
    (alone,) = compared("--groups", "TOM, mended", "MLE", "--by", "area")
    assert (alone["by"], alone["wins"]) == ("area under the curve", 1.0)
    assert alone["p of all"] == alone["p"] < of_two[0]["p of all"]
    (others,) = compared("--groups", "PMAC", "MLE", "--by", "area")
    assert (others["learner"], others["wins"]) == ("PMAC", 1.0)
    assert main([*words, "--groups", "MLE"]) == 2
    assert "name two of: MLE; PMAC" in capsys.readouterr().err
    assert main([*words, "--groups", "MLE", "TOM mended"]) == 2
    assert "but of: MLE; PMAC; TOM; TOM, mended" in capsys.readouterr().err


def test_exams_are_compared_on_the_screen_of_few_groups_and_in_a_file_of_all(
    tmp_path: Path, capsys
):
    store, out = Store(tmp_path / "store"), tmp_path / "out"
    for learner, preset in (
        ("mle", "paper"),
        ("pmac", "paper"),
        ("tom", "paper"),
        ("tom", "mended"),
    ):
        config = resolve("hopper", learner, preset)
        with Recorder(RunWriter.create(store, f"{learner}-{preset}", config)) as recorder:
            exam = dict.fromkeys(("exam/footprint", "exam/error", "exam/rollout_error"), 1.0)
            recorder.consume(Metrics(100, {"eval/return": 1.0} | exam))
            recorder.consume(Tick(100, "evaluate"))
    words = ["reproduce", "returns", "--store", str(store.path), "--out", str(out)]
    assert main([*words, "--preset", "paper", "mended"]) == 0
    assert capsys.readouterr().out.count("p of all") == 1  # of scores alone
    read = (out / "less.csv").read_text().splitlines()
    assert len(read) == 1 + 6 * 2  # no informative footprint, no rollouts
    assert main([*words, "--preset", "paper", "mended", "--groups", "TOM", "MLE"]) == 0
    assert capsys.readouterr().out.count("p of all") == 2
    assert main([*words, "--preset", "paper"]) == 0  # three groups
    assert capsys.readouterr().out.count("p of all") == 2


def test_runs_of_other_groups_bound_no_planned_comparison(tmp_path: Path, capsys):
    store = Store(tmp_path / "store")
    for learner, steps in (("pmac", (100, 500)), ("vagram", (1000, 2000)), ("ratio", (1000, 2000))):
        config = resolve("hopper", learner, "paper")
        with Recorder(RunWriter.create(store, learner, config)) as recorder:
            for step in steps:
                recorder.consume(Metrics(step, {"eval/return": float(step)}))
                recorder.consume(Tick(step, "evaluate"))
    words = ["reproduce", "returns", "--store", str(store.path), "--out", str(tmp_path / "out")]
    words += ["--preset", "paper", "--json", "--by", "last"]
    assert main([*words, "--groups", "VaGram (MDN)", "Ratio"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert {row["at step"] for row in found["summary"]} == {2000}
    three = ["--groups", "VaGram (MDN)", "PMAC", "Ratio"]
    assert main([*words, *three, "--at", "2000"]) == 2  # no comparison of the two that are left
    assert "no run of 'PMAC' can be compared with the others" in capsys.readouterr().err
    (row,) = found["improvement"]  # a comparison without MLE and TOM, because it was asked for
    assert {row["learner"], row["against"]} == {"VaGram (MDN)", "Ratio"}
    assert main(words) == 0
    assert {row["at step"] for row in json.loads(capsys.readouterr().out)["summary"]} == {500}


@pytest.mark.parametrize("at", [("hopper=2000", "1000"), ("1000", "hopper=2000")])
def test_a_step_of_one_task_counts_whatever_the_order(at: tuple[str, ...], tmp_path: Path, capsys):
    store = Store(tmp_path / "store")
    for env in ("hopper", "walker2d"):
        with Recorder(RunWriter.create(store, env, resolve(env, "mle", "paper"))) as recorder:
            for step in (1000, 2000):
                recorder.consume(Metrics(step, {"eval/return": float(step)}))
                recorder.consume(Tick(step, "evaluate"))
    words = ["reproduce", "returns", "--store", str(store.path), "--out", str(tmp_path / "out")]
    assert main([*words, "--preset", "paper", "--at", *at, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    steps = {row["env"]: row["at step"] for row in found["summary"]}
    assert steps == {"hopper": 2000, "walker2d": 1000}


@pytest.mark.parametrize(
    ("words", "named"),
    [
        ((), "tom sweep"),
        (("--env", "hoper"), "did you mean 'hopper'"),
        (("--learner", "tomm"), "did you mean 'tom'"),
        (("--preset", "papr"), "did you mean 'paper'"),
        (("--at", "0"), "--at must be at least 1"),
        (("--at", "late"), "or ENV=STEP, not 'late'"),
        (("--at", "hoper=9"), "did you mean 'hopper'"),
        (("--at", "9", "8"), "--at takes one step of all"),
        (("--env", "hopper", "--at", "ant=9"), "--at ant=9: --env does not name ant"),
    ],
)
def test_bad_input(words: tuple[str, ...], named: str, tmp_path: Path, capsys):
    store, out = tmp_path / "store", tmp_path / "out"
    asked = ["reproduce", "returns", *words, "--store", str(store), "--out", str(out)]
    assert main(asked) == 2
    assert named in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
