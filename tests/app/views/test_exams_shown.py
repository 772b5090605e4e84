"""Exams on the pages, of real recorded runs: Answer and Attention."""

import shutil
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from operator import attrgetter
from pathlib import Path

import numpy as np
import pytest
from streamlit.testing.v1 import AppTest
from studio_pages import (
    Show,
    array,
    captions,
    draw,
    figures,
    numbers_behind,
    parts,
    recorded,
    trace,
)
from studio_runs import PENDULUM_TOM, altered, info, set_status

from app.data import buffer
from app.views.answer.numbers import alternating_groups, split_by_length, table, verdict
from app.views.attention import difference_from_recorded, footprint_sentence
from tom.analysis.exams import Exams, ranking
from tom.readable import UNKNOWN, short
from tom.record import checkpoint
from tom.record.reader import RunReader

pytestmark = pytest.mark.usefixtures("studio")
PENDULUM, PENDULUM_MLE = "inverted-pendulum", "pendulum-mle-0"
GALLERY, GALLERY_TOM = Path(__file__).parents[3] / "runs", "hopper-tom-s0-bee6348e"


def test_attention_shows_the_exam_of_the_fit_that_is_looked_at(store: Path) -> None:
    steps, errors = recorded(store, PENDULUM_TOM, "exam/error")
    ahead = dict(zip(*recorded(store, PENDULUM_TOM, "exam/rollout_error"), strict=True))
    for step, error in zip(steps, errors, strict=True):
        app = draw("attention", task=PENDULUM, run=PENDULUM_TOM, step=str(step))
        (shown,) = parts(app, "tom_readout")
        at = shown["steps"].index(step)
        values = {number["label"]: number["values"][at] for number in shown["numbers"]}
        assert values["error, one step"] == short(error)
        assert values["error, five steps"] == short(ahead[step])


def test_a_footprint_that_its_noise_hides_is_not_shown(show: Show) -> None:
    show(GALLERY)
    (shown,) = parts(draw("attention", run=GALLERY_TOM), "tom_readout")
    values = {number["label"]: number["values"] for number in shown["numbers"]}
    noises = dict(zip(*recorded(GALLERY, GALLERY_TOM, "exam/footprint_noise"), strict=True))
    told = {step: abs(noises[step]) < 1 for step in shown["steps"] if step in noises}
    assert {*told.values()} == {True, False}
    for step, footprint in zip(shown["steps"], values["footprint"], strict=True):
        assert (footprint != UNKNOWN) == told.get(step, False)


def test_the_numbers_behind_are_those_of_the_exams(store: Path) -> None:
    app = numbers_behind(task=PENDULUM)
    assert any("Too few seeds" in part.value for part in app.markdown)
    [shown] = [part.value for part in app.dataframe if "five steps" in part.value]
    # Only the last fits of TOM weigh, so only these count.
    tables = [RunReader(store / f"pendulum-tom-{seed}").metrics() for seed in (0, 1)]
    weighed = [table.loc[table["weights/ess"] < 1, "env_step"].tolist() for table in tables]
    assert weighed == [[300], [300]]
    last = [float(t.loc[t["env_step"] == 300, "exam/error"].max()) for t in tables]
    tom = shown.set_index("group").loc["TOM"]
    assert (tom["runs"], tom["fits"]) == (2, 2)
    assert tom["one step"].startswith(f"{np.mean(last):.4g} ")
    figure = next(f for f in figures(app) if trace_or_none(f, "mle"))
    fits = {(x, y) for t in figure["data"] if t.get("meta") == "tom" for x, y in points(t)}
    for step, error in zip(*recorded(store, PENDULUM_TOM, "exam/error"), strict=True):
        at, value = recorded(store, PENDULUM_TOM, "eval/return")
        following = [v for s, v in zip(at, value, strict=True) if s > step]
        assert (following[0], error) in fits


def trace_or_none(figure: dict, learner: str) -> dict | None:
    return next((t for t in figure["data"] if t.get("meta") == learner and "hovertext" in t), None)


def points(one: dict) -> list[tuple[float, float]]:
    return list(zip(array(one["x"]).tolist(), array(one["y"]).tolist(), strict=True))


@pytest.mark.parametrize(
    ("footprint", "uniform", "noise", "said"),
    [
        (0.6, 0.4, 0.1, "nearer"),
        (0.95, 0.4, -0.1, "noise"),
        (1.5, 0.4, 0.1, "away"),
        (0.1, 0.002, 1.2, "cannot"),
        (None, -0.01, None, "cannot"),
        (None, None, None, "few"),
    ],
)
def test_a_footprint_in_words(
    footprint: float | None, uniform: float | None, noise: float | None, said: str
) -> None:
    values = {"footprint": footprint, "footprint_uniform": uniform, "footprint_noise": noise}
    found = {f"exam/{name}": value for name, value in values.items() if value is not None}
    assert said in footprint_sentence(found)


@pytest.mark.parametrize(
    ("learner", "settings", "differs"),
    [
        ("mle", {"model.weight_clip": "10.0", "model.uniform_share": "0.0"}, False),
        ("tom", {}, False),
        ("tom", {"model.weight_clip": "10.0"}, True),
        ("pmac", {"model.uniform_share": "0.5"}, True),
        ("tom", {"model.uniform_share": "1.0"}, True),
    ],
)
def test_an_exam_says_where_it_is_of_other_weights(
    learner: str, settings: Mapping[str, str], differs: bool
) -> None:
    assert bool(difference_from_recorded(learner, settings)) == differs


def learners(errors: Mapping[str, list[float]]) -> list[Exams]:
    """A run for each error of a learner's, with one fit."""
    none = np.full(1, np.nan)
    return [
        Exams(f"{name}-{seed}", name.lower(), seed, name, np.array([100]), np.array([error]),
              none, none, none, none)
        for name, values in errors.items()
        for seed, error in enumerate(values)
    ]  # fmt: skip


def test_the_verdict_names_who_errs_least_and_by_how_much() -> None:
    runs = learners({"MLE": [0.2] * 5, "TOM": [0.15] * 5, "PMAC": [0.01] * 4})
    said = verdict(ranking(runs))
    assert "TOM errs least" in said
    assert "25 %" in said
    assert "p 0.0079" in said
    shown = table(ranking(runs)).set_index("group")
    assert shown.loc["TOM", "one step"] == "0.15 [0.15, 0.15]"
    assert shown.loc["PMAC", "seeds"] == 4


@pytest.mark.parametrize(
    ("mle", "tom"),
    [
        # The interval is too narrow for five runs: above a half here, with a p of .1 and more.
        ([0.23, 0.30, 0.33, 0.36, 0.41], [0.10, 0.18, 0.22, 0.26, 0.35]),
        ([0.1, 0.2, 0.3, 0.4, 0.5], [0.1, 0.2, 0.3, 0.4, 0.51]),
    ],
)
def test_the_verdict_ranks_nobody_within_the_noise(mle: list[float], tom: list[float]) -> None:
    result = ranking(learners({"MLE": mle, "TOM": tom}))
    assert result.p_value > 0.05
    assert "errs least" not in verdict(result)


# The errors of kept models on one buffer

OTHER_TOM, MLE = "pendulum-tom-1", "pendulum-mle-0"


behind = partial(numbers_behind, task="inverted-pendulum", run=PENDULUM_TOM)


def left_out(app: AppTest) -> list[str]:
    """The lines that name runs which are left out."""
    return [line for line in captions(app).splitlines() if line.startswith("Left out")]


def test_every_kept_model_is_asked_about_the_same_buffer(store: Path) -> None:
    run, other = info(store, PENDULUM_TOM), info(store, MLE)
    own, theirs = buffer.errors_on(run, run), buffer.errors_on(run, other)
    assert own is not None
    assert theirs is not None
    assert len(own) == len(theirs) == 400
    here = figures(behind())[-1]
    for name, errors in (("TOM s0 (its own)", own), ("MLE s0", theirs)):
        assert array(trace(here, name=name)["y"]) == pytest.approx(errors.reshape(20, -1).mean(1))


def test_a_buffer_that_cannot_be_read_is_no_error(own: Path) -> None:
    *others, _ = sorted((own / PENDULUM_TOM / "buffer").glob("*.npz"))
    for segment in others:
        segment.write_bytes(b"torn")
    drawn = figures(behind())
    names = [line.get("name", "") for figure in drawn for line in figure["data"]]
    assert "MLE s0" not in names  # on this buffer


def test_models_of_all_groups_come_before_a_groups_second_one(store: Path) -> None:
    runs = [info(store, name) for name in (OTHER_TOM, PENDULUM_TOM, MLE)]
    learner = attrgetter("learner")
    assert [run.run_id for run in alternating_groups(runs[1], runs, learner)] == [
        PENDULUM_TOM,
        OTHER_TOM,
        MLE,
    ]
    assert [run.run_id for run in alternating_groups(runs[2], runs, learner)] == [
        MLE,
        OTHER_TOM,
        PENDULUM_TOM,
    ]


def test_runs_of_another_length_are_left_out_and_named(store: Path, own: Path) -> None:
    runs = [info(store, run_id) for run_id in (PENDULUM_TOM, OTHER_TOM, MLE)]
    short = altered(runs[0], status=replace(runs[0].status, env_step=150))
    assert split_by_length([short, *runs]) == (runs, [short])
    assert split_by_length([]) == ([], [])
    set_status(own / OTHER_TOM, env_step=90)
    app = behind()
    assert any("TOM s1" in line and "90" in line for line in left_out(app))
    assert not any("TOM s1" in line["name"] for line in figures(app)[-1]["data"])


def test_a_run_that_kept_no_model_is_named(own: Path) -> None:
    shutil.rmtree(own / MLE / checkpoint.FOLDER)
    (said,) = left_out(behind())
    assert ("MLE" in said, "TOM" in said, "model" in said) == (True, False, True)
