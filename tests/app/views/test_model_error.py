"""Answer's numbers behind it: the errors of kept models on one buffer, and those recorded."""

import json
import shutil
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from streamlit.testing.v1 import AppTest
from studio_pages import array, captions, figures, numbers_behind, recorded, trace
from studio_runs import PENDULUM_TOM, altered, info, set_status

from app.data import buffer, readers
from app.views.answer.numbers import focus_values, in_turn, of_like_length
from tom.record import checkpoint, layout
from tom.record.reader import RunReader

pytestmark = pytest.mark.usefixtures("studio")
OTHER_TOM, MLE = "pendulum-tom-1", "pendulum-mle-0"
ERRORS = "model/error_policy", "model/error_other"


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
    here, one_step, five_steps = figures(behind())[-3:]
    for name, errors in (("TOM s0 (its own)", own), ("MLE s0", theirs)):
        assert array(trace(here, name=name)["y"]) == pytest.approx(errors.reshape(20, -1).mean(1))
    for figure, what in ((one_step, "error"), (five_steps, "rollout_error")):
        for run_id in (PENDULUM_TOM, OTHER_TOM, MLE):
            pair = [recorded(store, run_id, f"model/{what}_{of}")[1] for of in ("policy", "other")]
            assert array(trace(figure, meta=run_id)["y"]).tolist() == [of[-1] for of in pair]


def test_a_buffer_that_cannot_be_read_is_no_error(own: Path) -> None:
    *others, _ = sorted((own / PENDULUM_TOM / "buffer").glob("*.npz"))
    for segment in others:
        segment.write_bytes(b"torn")
    drawn = figures(behind())
    names = [line.get("name", "") for figure in drawn for line in figure["data"]]
    assert "MLE s0" not in names  # on this buffer
    assert trace(drawn[-1], meta=PENDULUM_TOM)


def test_models_of_all_groups_come_before_a_groups_second_one(store: Path) -> None:
    runs = [info(store, name) for name in (OTHER_TOM, PENDULUM_TOM, MLE)]
    assert [run.run_id for run in in_turn(runs[1], runs)] == [PENDULUM_TOM, OTHER_TOM, MLE]
    assert [run.run_id for run in in_turn(runs[2], runs)] == [MLE, OTHER_TOM, PENDULUM_TOM]
    # Two presets of a learner are two groups.
    runs = [runs[1], altered(runs[0], preset="mended"), runs[2]]
    found = focus_values(runs, *ERRORS)
    assert {name: [run_id for run_id, *_ in of] for name, of in found.items()} == {
        f"TOM {runs[0].preset}": [PENDULUM_TOM],
        "TOM mended": [OTHER_TOM],
        "MLE": [MLE],
    }


def test_errors_in_sample_are_of_the_last_fits_that_every_run_reaches(
    store: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Errors fall as data come: who trained for longer must not win by that."""
    last = {OTHER_TOM: 400, MLE: 250}

    def metrics(run: RunReader) -> pd.DataFrame:
        step = np.arange(100, last[run.run_id] + 1, 50)
        return pd.DataFrame({"env_step": step, "one": 1 / step, "other": 2 / step})

    monkeypatch.setattr(readers, "metrics", metrics)
    found = focus_values([info(store, name) for name in last], "one", "other")
    assert {name: of[0][2:] for name, of in found.items()} == {
        "TOM": (1 / 250, 2 / 250),
        "MLE": (1 / 250, 2 / 250),
    }


def test_runs_of_another_length_are_left_out_and_named(store: Path, own: Path) -> None:
    runs = [info(store, run_id) for run_id in (PENDULUM_TOM, OTHER_TOM, MLE)]
    short = altered(runs[0], status=replace(runs[0].status, env_step=150))
    assert of_like_length([short, *runs]) == (runs, [short])
    assert of_like_length([]) == ([], [])
    set_status(own / OTHER_TOM, env_step=90)
    app = behind()
    assert any("TOM s1" in line and "90" in line for line in left_out(app))
    for figure in figures(app)[-3:]:
        assert all(line.get("meta") != OTHER_TOM for line in figure["data"])


def test_a_run_that_measured_nothing_or_kept_no_model_is_named(own: Path) -> None:
    run = own / MLE
    rows = [json.loads(line) for line in (run / layout.METRICS).read_text().splitlines()]
    kept = [{n: v for n, v in row.items() if not n.startswith("model/")} for row in rows]
    (run / layout.METRICS).write_text("".join(json.dumps(row) + "\n" for row in kept))
    (run / layout.METRICS_TABLE).unlink(missing_ok=True)
    shutil.rmtree(run / checkpoint.FOLDER)
    said = left_out(behind())
    assert [("MLE" in words, "TOM" in words) for words in said] == [(True, False)] * 3
    assert ["model" in words for words in said] == [True, False, False]
