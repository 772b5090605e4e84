"""Pages on a small copy without buffer, model and policy: they say that those were left out."""

import json
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
import streamlit as st
from streamlit.testing.v1 import AppTest
from studio_pages import draw, set_links
from studio_runs import info

from app.data import readers
from app.links import Links
from app.parts import empty
from app.parts.widgets import differs, most_telling
from app.views.compare.labels import overview
from tom.record import RunReader, Store
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
    ("view", "run", "words"),
    [
        ("weights", PENDULUM, "Left out of this small copy: buffer."),
        ("regions", PENDULUM, "Left out of this small copy: buffer."),
        ("road", ROAD, "Left out of this small copy: buffer"),
        ("replays", PENDULUM, "kept no dynamics model\\: left out of this small copy."),
        ("replays", PENDULUM, "Left out of this small copy: other evaluations, other episodes."),
        ("probe", PENDULUM, "Left out of the small copy in this store: buffer."),
    ],
)
def test_what_was_left_out_is_named(view: str, run: RunReader, words: str) -> None:
    assert words in said(draw(view, run=run.run_id))


def test_live_says_that_evaluations_were_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    export_small(PENDULUM, tmp_path, without=("evaluations",))
    set_links(Links(store=str(tmp_path), key="key"), monkeypatch)
    words = said(draw("live", runs=PENDULUM.run_id))
    assert "Left out of this small copy: evaluations." in words
    assert "comes with the first" not in words


def test_live_says_why_a_recording_of_sac_has_no_weights(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (recording,) = (r for r in small_copies(Store(GALLERY)) if r.run_id == "hopper-sac-s0")
    export_small(recording, tmp_path)
    set_links(Links(store=str(tmp_path), key="key"), monkeypatch)
    app = draw("live", runs="hopper-sac-s0")
    assert said(app).count("SAC alone fits no model") == 2  # the map, the weights of the last fit
    assert not [toggle for toggle in app.toggle if toggle.label == "Log axis"]


def test_side_by_side_says_that_evaluations_were_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = next(run for run in TOM if run.env == PENDULUM.env and run.run_id != PENDULUM.run_id)
    for run, without in ((PENDULUM, ("evaluations",)), (other, ())):
        export_small(run, tmp_path, without=without)
    set_links(Links(store=str(tmp_path), key="key"), monkeypatch)
    sides = [PENDULUM.run_id, other.run_id]
    words = said(draw("compare", show="Side by side", side=sides))
    assert "left out of its small copy" in words
    assert "not evaluated yet" not in words
    shutil.rmtree(tmp_path / other.run_id)
    export_small(other, tmp_path, without=("evaluations",))
    st.cache_data.clear()
    assert "Left out of this small copy: evaluations." in said(
        draw("compare", show="Side by side", side=sides)
    )


def test_of_a_whole_run_nothing_was_left_out(bare: Path) -> None:
    shown = info(bare, PENDULUM.run_id)
    assert not empty.left_out(shown, "episodes")
    assert not empty.left_out_of_all([shown], "episodes")


def test_the_table_of_runs_and_the_cards_say_which_is_one(bare: Path) -> None:
    config = bare / ROAD.run_id / "config.json"
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
