"""The store that `tom bench studio` measures with, and what its rows say."""

import os
from pathlib import Path

import pytest

from app.data import readers, studies
from app.router import VIEWS
from app.servers.bench import (
    FIGURES,
    KINDS,
    LINES,
    METRICS,
    OPEN_S,
    POINTS,
    STUDIES,
    main,
    make_store,
    make_studies,
    measure,
)
from tom.cli import bench
from tom.cli import main as tom


@pytest.mark.slow
def test_the_store_is_as_large_as_the_measurement_says(tmp_path: Path) -> None:
    make_store(tmp_path, len(KINDS) + 2)
    listing = readers.listing(str(tmp_path))
    assert listing.problems == ()
    assert {(run.env, run.learner, run.seed) for run in listing.runs} == {
        *((env, learner, 0) for env, learner, _ in KINDS),
        *((env, learner, 1) for env, learner, _ in KINDS[:2]),
    }
    for run in listing.runs:
        assert readers.metrics(run).shape == (POINTS, METRICS + 1)
        assert len(readers.profiles(run).env_step) == POINTS
        assert readers.problems(run) == []


def test_the_studies_have_figures_and_a_table(tmp_path: Path) -> None:
    make_studies(tmp_path)
    found = studies.listing(tmp_path)
    assert [len(study.figures) for study in found] == [FIGURES] * STUDIES
    for study in found:
        assert study.report is not None
        table = studies.table(study.tables[0])
        assert table is not None
        assert len(table) == LINES


def test_opening_is_the_reading_of_the_store_and_the_first_page(
    store: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "environ", os.environ.copy())
    rows = list(measure(store))
    read, first, opened = rows[:3]
    assert [read.what, first.what] == ["store read", "answer, first"]
    assert opened.cpu_s == read.cpu_s + first.cpu_s
    assert (read.target_s, opened.target_s) == (None, OPEN_S)
    pages = [row.what for row in rows if row is not opened][1:]
    names = [view.TITLE for view in VIEWS]
    assert len(pages) == 3 * len(names)
    four = [row for row in rows if row.what.endswith(", four readers")]
    assert [row.target_s for row in four] == [OPEN_S] * len(names)
    assert all(row.cpu_s > 0 for row in rows)


def test_the_number_of_runs_reaches_the_measurement(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(bench, "hand_over", lambda _, words: main(words))
    with pytest.raises(SystemExit) as ended:
        tom(["bench", "studio", "--runs", "2", "--json"])
    assert ended.value.code == 2
    assert f"--runs 2: at least {len(KINDS)}" in capsys.readouterr().err
