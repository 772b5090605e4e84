"""Probe: stored weighings of a run's buffer, and what the learners' models err."""

import json
import shlex
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from streamlit.testing.v1 import AppTest
from studio_pages import array, captions, draw, figures, set_links, trace
from studio_runs import PENDULUM_TOM, altered, info, set_status, with_weighing

from app.data import buffer, readers, weighings
from app.figures.probe import RunErrors
from app.links import Links
from app.parts import widgets
from app.views.probe.answer import in_sample, sentence
from app.views.probe.length import of_like_length
from app.views.probe.model_error import focus_values, in_turn
from app.views.probe.start import FOREIGN
from tom import plugins
from tom.analysis.progression import progression
from tom.cli import main
from tom.record import checkpoint, layout
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
def weighed(
    studio: Links, store: Path, results: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Path:
    """The studio shows a store with that weighing."""
    there = with_weighing(store, results, tmp_path)
    set_links(Links(store=str(there), key="key"), monkeypatch)
    return there / "weighings" / "made"


@pytest.mark.parametrize(("towers", "axis"), [(0.5, "log"), (1e9, "linear")])
def test_where_one_learners_weights_tower_they_are_on_a_log_axis(
    towers: float, axis: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(widgets, "TOWERS", towers)
    app = draw("probe", run=PENDULUM_TOM)
    assert figures(app)[0]["layout"]["yaxis"]["type"] == axis


def test_a_weighing_is_found_by_its_run(weighed: Path) -> None:
    run = info(weighed.parents[1], PENDULUM_TOM)
    (found,) = weighings.of_run(run, ROWS)
    assert (found.name, found.policy, found.missing(ROWS)) == ("made", PENDULUM_TOM, "")
    assert "tom.q_steps 30" in found.settings
    assert weighings.of_run(info(weighed.parents[1], "pendulum-mle-0"), ROWS) == []
    assert weighings.of_run(run, ROWS - 1) == []
    table = pd.read_parquet(weighed / "weights.parquet")
    of = found.weights()
    assert set(of) == {(name, seed) for name in ("tom", "pmac", "mle") for seed in (0, 1)}
    assert of["tom", 1] == pytest.approx(table["tom-s1"].to_numpy())


def test_all_learners_lie_over_one_buffer_with_the_reports_numbers(weighed: Path) -> None:
    app = draw("probe", run=PENDULUM_TOM)
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
    assert shown.loc["TOM", "ESS"] == pytest.approx(np.median([p.ess for p in expected]))
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
    shown = draw("probe", run=PENDULUM_TOM).dataframe[0].value.set_index("learner")
    assert shown.loc["TOM", "footprint"].startswith(f"{value:.2f}")


def test_a_weighing_of_a_run_that_went_on_is_of_its_first_rows(weighed: Path) -> None:
    for segment in sorted((weighed.parents[1] / PENDULUM_TOM / "buffer").glob("*.npz")):
        shutil.copy(segment, segment.with_name(f"{int(segment.stem) + ROWS:09d}.npz"))
    app = draw("probe", run=PENDULUM_TOM)
    assert trace(figures(app)[0], meta="tom")
    assert any(f"first {ROWS} of now {2 * ROWS} trans" in words.value for words in app.caption)
    run = info(weighed.parents[1], PENDULUM_TOM)
    [found] = weighings.of_run(run, 2 * ROWS)
    rows = buffer.weighed_rows(run, found.weights()["tom", 0], found.end)
    assert rows is not None
    assert (rows.first, len(rows)) == (0, ROWS)


def test_damaged_weighings_are_left_out(weighed: Path) -> None:
    run = info(weighed.parents[1], PENDULUM_TOM)
    (weighed / "weights.parquet").write_bytes(b"torn")
    assert weighings.of_run(run, ROWS)[0].weights() == {}
    assert draw("probe", run=PENDULUM_TOM).warning
    (weighed / REPORT).write_text("[")
    assert weighings.of_run(run, ROWS) == []


@pytest.mark.parametrize(
    ("view", "words", "step"),
    [
        ("probe", {}, None),
        ("regions", {"weights": "TOM s1, made"}, None),
        ("weights", {"step": "300"}, 300),
    ],
)
def test_what_the_learners_noticed_stands_beside_their_weights(
    view: str, words: dict[str, str], step: int | None, weighed: Path
) -> None:
    assert not draw(view, run=PENDULUM_TOM, **words).warning
    report = json.loads((weighed / REPORT).read_text()) | {"step": step}
    of_tom = [result for result in report["results"] if result["learner"] == "tom"]
    for result in of_tom:
        result["notices"] = ["no trust in this"]
    (weighed / REPORT).write_text(json.dumps(report))
    (said,) = draw(view, run=PENDULUM_TOM, **words).warning
    assert "no trust in this" in said.value
    assert "TOM" in said.value


def test_every_learner_on_the_buffer_of_a_fit(weighed: Path) -> None:
    there = weighed.parents[1]
    step = RunReader(there / PENDULUM_TOM).policy_steps()[1]
    address = f"/probe?run={PENDULUM_TOM}&at={step}"
    app = draw("weights", run=PENDULUM_TOM, step=str(step))
    assert address in captions(app)
    asked = draw("probe", run=PENDULUM_TOM, at=str(step))
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
    app = draw("weights", run=PENDULUM_TOM, step=str(step))
    assert address not in captions(app)
    shown = next(f for f in figures(app) if any(t.get("meta") == "vagram" for t in f["data"]))
    for learner in ("pmac", "vagram"):
        line = array(trace(shown, meta=learner)["y"])
        assert line == pytest.approx(np.asarray(profile[learner]), rel=1e-3)
    there_too = f"{address}&weighed={made.name})"
    assert any(there_too in words.value for words in app.markdown)
    whole = draw("probe", run=PENDULUM_TOM, at=str(step), weighed=made.name)
    assert f"{step} transitions" in captions(whole)


def test_a_policy_of_another_library_is_typed_in_a_terminal(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv(plugins.VARIABLE, '["/somewhere/own.py"]')
    app = draw("probe", run="pendulum-mle-0")  # which nobody has weighed
    app.selectbox(key="weigh policy").select(FOREIGN).run()
    app.text_input(key="weigh foreign").input("my policy.pt").run()
    (typed,) = (code.value for code in app.code if code.value.startswith("tom weigh pendulum"))
    words = shlex.split(typed)
    assert words[words.index("--policy") + 1] == "my policy.pt"
    assert words[-2:] == ["--plugin", "/somewhere/own.py"]
    assert "weigh" not in [button.key for button in app.button]


@pytest.mark.slow
def test_the_page_starts_a_weighing_and_shows_it() -> None:
    app = draw("probe", run="pendulum-mle-0")
    app.multiselect(key="weigh learners").set_value(["mle", "pmac"])
    app.number_input(key="weigh seeds").set_value(1)
    app.button(key="weigh").click().run()
    begun = app.session_state["weighing"]
    assert begun.process.wait(60) == 0, begun.tail()
    app.run()
    assert not app.exception
    assert [trace(figures(app)[0], meta=name)["meta"] for name in ("mle", "pmac")]


def test_every_kept_model_is_asked_about_the_same_buffer(store: Path) -> None:
    run, other = info(store, PENDULUM_TOM), info(store, "pendulum-mle-0")
    own, theirs = buffer.errors_on(run, run), buffer.errors_on(run, other)
    assert own is not None
    assert theirs is not None
    assert len(own) == len(theirs) == ROWS
    line = trace(figures(draw("probe", run=PENDULUM_TOM))[2], name="TOM s0 (its own)")
    assert array(line["y"]) == pytest.approx(own.reshape(20, -1).mean(1))


@pytest.mark.parametrize("torn", ["every segment", "all but the last"])
def test_a_buffer_that_cannot_be_read_is_no_error(torn: str, own: Path) -> None:
    *others, last = sorted((own / PENDULUM_TOM / "buffer").glob("*.npz"))
    for segment in [*others, last] if torn == "every segment" else others:
        segment.write_bytes(b"torn")
    app = draw("probe", run=PENDULUM_TOM)
    assert bool(app.warning) == (torn == "every segment")
    assert ("whose errors could be shown" in captions(app)) == (torn == "all but the last")


def test_models_of_all_learners_come_before_a_learners_second_one(store: Path) -> None:
    runs = [info(store, name) for name in ("pendulum-tom-1", PENDULUM_TOM, "pendulum-mle-0")]
    turns = [run.run_id for run in in_turn(runs[1], runs)]
    assert turns == [PENDULUM_TOM, "pendulum-tom-1", "pendulum-mle-0"]
    turns = [run.run_id for run in in_turn(runs[2], runs)]
    assert turns == ["pendulum-mle-0", "pendulum-tom-1", PENDULUM_TOM]


def test_does_it_help_shows_what_the_runs_measured(store: Path) -> None:
    runs = [info(store, name) for name in (PENDULUM_TOM, "pendulum-tom-1", "pendulum-mle-0")]
    found = focus_values(runs, "model/error_policy", "model/error_other")
    assert {name: len(values) for name, values in found.items()} == {"TOM": 2, "MLE": 1}
    recorded = RunReader(store / "pendulum-mle-0").metrics()["model/error_policy"].dropna()
    [mle] = found["MLE"]
    assert mle.policy == recorded.iloc[-1]
    one_step = figures(draw("probe", run=PENDULUM_TOM))[3]
    line = trace(one_step, meta="pendulum-mle-0")
    assert array(line["y"]).tolist() == [mle.policy, mle.other]


def test_errors_in_sample_are_of_the_last_fits_that_every_run_reaches(
    store: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Errors fall as data come: who trained for longer must not win by that."""
    last = {"pendulum-tom-1": 400, "pendulum-mle-0": 250}

    def metrics(run: RunReader) -> pd.DataFrame:
        step = np.arange(100, last[run.run_id] + 1, 50)
        return pd.DataFrame({"env_step": step, "one": 1 / step, "other": 2 / step})

    monkeypatch.setattr(readers, "metrics", metrics)
    found = focus_values([info(store, name) for name in last], "one", "other")
    assert {name: (of[0].policy, of[0].other) for name, of in found.items()} == {
        "TOM": (1 / 250, 2 / 250),
        "MLE": (1 / 250, 2 / 250),
    }


def test_two_presets_of_a_learner_are_two_groups(store: Path) -> None:
    runs = [info(store, name) for name in (PENDULUM_TOM, "pendulum-tom-1", "pendulum-mle-0")]
    runs[1] = altered(runs[1], preset="mended")
    found = focus_values(runs, "model/error_policy", "model/error_other")
    presets = {f"TOM, {run.preset}": [run.run_id] for run in runs[:2]}
    assert {name: [run.run_id for run in of] for name, of in found.items() if "TOM" in name} == (
        presets
    )
    turns = [run.run_id for run in in_turn(runs[0], runs)]
    assert turns == [PENDULUM_TOM, "pendulum-tom-1", "pendulum-mle-0"]


def test_regions_can_show_a_weighings_weights(weighed: Path) -> None:
    weight = pd.read_parquet(weighed / "weights.parquet")["tom-s1"].to_numpy()
    app = draw("regions", run=PENDULUM_TOM, weights="TOM s1, made")
    table = app.dataframe[0].value.set_index("")
    heaviest = np.sort(weight)[-round(0.01 * ROWS) :]
    assert table.loc["mean weight", "region"] == f"{heaviest.mean():,.2f}"
    assert table.loc["transitions", "buffer"] == str(ROWS)


def test_a_run_that_was_stopped_early_has_no_part(store: Path) -> None:
    runs = [info(store, run_id) for run_id in (PENDULUM_TOM, "pendulum-tom-1", "pendulum-mle-0")]
    short = altered(runs[0], status=replace(runs[0].status, env_step=150))
    assert of_like_length([short, *runs]) == (runs, [short])
    assert of_like_length([]) == ([], [])


def left_out(app: AppTest) -> list[str]:
    """The lines that name runs which are left out."""
    return [line for line in captions(app).splitlines() if line.startswith("Left out")]


def test_runs_that_ended_early_or_fitted_no_model_are_left_out_and_named(own: Path) -> None:
    set_status(own / "pendulum-tom-1", env_step=90)
    words = ["record-sac", "--env", "inverted-pendulum", "--steps", "200", "--run-id", "alone"]
    words += ["--exploration-steps", "100", "--sac.hidden", "16", "--evaluation.episodes", "1"]
    assert main([*words, "--store", str(own), "--no-rerun"]) == 0
    app = draw("probe", run=PENDULUM_TOM)
    assert any("TOM s1" in line and "90" in line for line in left_out(app))
    assert any("SAC s0" in line for line in left_out(app))
    for figure in figures(app):
        assert all(line.get("meta") != "pendulum-tom-1" for line in figure["data"])


def test_a_run_that_measured_nothing_or_kept_no_model_is_named(own: Path) -> None:
    run = own / "pendulum-mle-0"
    rows = [json.loads(line) for line in (run / layout.METRICS).read_text().splitlines()]
    kept = [{n: v for n, v in row.items() if not n.startswith("model/")} for row in rows]
    (run / layout.METRICS).write_text("".join(json.dumps(row) + "\n" for row in kept))
    (run / layout.METRICS_TABLE).unlink(missing_ok=True)
    shutil.rmtree(run / checkpoint.FOLDER)
    said = left_out(draw("probe", run=PENDULUM_TOM))
    assert [("MLE" in words, "TOM" in words) for words in said] == [(True, False)] * 3
    assert ["model" in words for words in said] == [True, False, False]


def test_a_run_without_a_buffer_has_its_part_in_what_was_recorded(own: Path) -> None:
    shutil.rmtree(own / "pendulum-mle-0" / "buffer")
    drawn = figures(draw("probe", run=PENDULUM_TOM))
    for figure in drawn[-2:]:
        assert any(line.get("meta") == "pendulum-mle-0" for line in figure["data"])
    assert trace(drawn[-3], name="MLE s0")


def errors_of(name: str, *policy: float) -> dict[str, list[RunErrors]]:
    return {name: [RunErrors(f"{name} {i}", "tom", value, 0.0) for i, value in enumerate(policy)]}


def test_an_answer_says_by_how_much_and_whether_beyond_noise() -> None:
    near = errors_of("MLE", *[1.0, 1.2] * 3) | errors_of("TOM", *[0.9, 1.1] * 3)
    said = sentence(in_sample(near | errors_of("VaGram", *[0.1] * 4) | errors_of("PMAC", np.nan)))
    assert "TOM errs least" in said  # the four are too few to be ranked
    assert "9 % less" in said
    error = np.std([0.9, 1.1] * 3, ddof=1) * np.sqrt(2 / 6)
    assert f"No more than noise: the gap is 0.1, its standard error {error:.2g}" in said
    far = errors_of("TOM", *[1.0] * 5) | errors_of("MLE", *[2.0] * 5)
    assert "More than noise: the gap is 1" in sentence(in_sample(far))
    few = errors_of("TOM", 1.0, 1.2) | errors_of("MLE", *[2.0] * 5)
    for found in (few, errors_of("TOM", 1.0), {}):
        assert "TOM errs least" not in sentence(in_sample(found))
