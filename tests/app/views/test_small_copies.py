"""Pages on a small copy without buffer, model and policy: they say that those were left out."""

import json
from collections.abc import Iterator
from pathlib import Path

import pytest
import streamlit as st
from streamlit.testing.v1 import AppTest
from studio_pages import captions, draw, set_links
from studio_runs import info

from app.data import readers
from app.links import Links
from app.parts.widgets import differs, most_telling
from app.views.compare.labels import overview
from app.views.live.now import NO_MODEL
from tom.record import RunReader, Store, layout
from tom.record.export import export_small
from tom.reports.index import small_copies

GALLERY = Path(__file__).parents[3] / "runs"
TOM = [r for r in small_copies(Store(GALLERY)) if r.learner == "tom"]
ROAD, PENDULUM = (
    next(run for run in TOM if run.env == env) for env in ("road-and-rocks", "inverted-pendulum")
)


@pytest.fixture
def bare(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Copies of two runs of the gallery; nothing of them is small enough to be kept."""
    monkeypatch.setattr("tom.record.thin.SMALL", 100)
    for run in (ROAD, PENDULUM):
        export_small(run, tmp_path)
    set_links(Links(store=str(tmp_path), key="key"), monkeypatch)
    yield tmp_path
    st.cache_data.clear()
    st.cache_resource.clear()


def said(app: AppTest) -> str:
    assert not app.warning
    return "\n".join(part.value for part in [*app.caption, *app.info])


@pytest.mark.usefixtures("bare")
@pytest.mark.parametrize(
    ("view", "run", "part"),
    [
        ("weights", PENDULUM, "buffer"),
        ("regions", PENDULUM, "buffer"),
        ("road", ROAD, "buffer"),
        ("replays", PENDULUM, "dynamics model"),
        ("replays", PENDULUM, "other evaluations, other episodes"),
        ("probe", PENDULUM, "buffer"),
    ],
)
def test_what_was_left_out_is_named(view: str, run: RunReader, part: str) -> None:
    lines = said(draw(view, run=run.run_id)).splitlines()
    assert any(part in line and "left out" in line.lower() for line in lines)


def test_evaluations_that_were_left_out_are_not_called_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = next(run for run in TOM if run.env == PENDULUM.env and run.run_id != PENDULUM.run_id)
    for run, without in ((PENDULUM, ("evaluations",)), (other, ())):
        export_small(run, tmp_path, without=without)
    set_links(Links(store=str(tmp_path), key="key"), monkeypatch)
    words = said(draw("live", runs=PENDULUM.run_id))
    assert "left out" in words.lower()
    assert "comes with the first" not in words
    sides = [PENDULUM.run_id, other.run_id]
    words = said(draw("compare", show="Side by side", side=sides))
    assert "left out" in words.lower()
    assert "not evaluated yet" not in words


def test_a_recording_of_sac_has_no_weights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (recording,) = (r for r in small_copies(Store(GALLERY)) if r.run_id == "hopper-sac-s0")
    export_small(recording, tmp_path)
    set_links(Links(store=str(tmp_path), key="key"), monkeypatch)
    app = draw("live", runs="hopper-sac-s0")
    assert captions(app).count(NO_MODEL) == 2  # the map, the weights of the last fit
    assert not [toggle for toggle in app.toggle if toggle.label == "Log axis"]


def test_the_table_of_runs_and_the_cards_say_which_is_one(bare: Path) -> None:
    config = bare / ROAD.run_id / layout.CONFIG
    content = json.loads(config.read_text())
    del content["thinned"]
    config.write_text(json.dumps(content))
    copy, whole = info(bare, PENDULUM.run_id), info(bare, ROAD.run_id)
    assert list(overview([copy, whole])["state"]) == ["finished (a small copy)", "finished"]
    (bar,) = draw("live", runs=PENDULUM.run_id).get("progress")
    assert bar.proto.text.endswith(" steps · a small copy")
    (bar,) = draw("live", runs=ROAD.run_id).get("progress")
    assert bar.proto.text.endswith(" steps")


def test_pages_open_with_ones_own_newest_run_and_else_with_toms_longest_copy(store: Path) -> None:
    copies = readers.listing(str(GALLERY)).runs
    first = most_telling(copies)
    assert (first.env, first.learner) == ("hopper", "tom")
    assert "buffer" not in first.left_out  # as its twin of another seed's is
    own = readers.listing(str(store)).runs
    mixed = [*copies, *own]
    newest = next(run for run in own if differs(run))
    assert most_telling(mixed) == newest
    uniform = [run for run in copies if run.learner == "mle"]
    assert most_telling(uniform).status.env_step == max(run.status.env_step for run in uniform)
