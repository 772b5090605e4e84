"""Pages on a small copy without buffer, model and policy: they say that those were left out."""

import json
import shutil
from pathlib import Path

import pytest
from streamlit.testing.v1 import AppTest
from studio_pages import Show, draw, figures, on_one_buffer
from studio_runs import info

from app.data import readers
from app.parts.start import progress_line
from app.parts.widgets import has_uneven_weights, interest_key
from app.views.attention import LEARNERS_ON_IT
from app.views.curves.runs import overview
from tom.record import RunReader, Store, layout
from tom.record.export import export_small
from tom.reports.index import small_copies

GALLERY = Path(__file__).parents[3] / "runs"
TOM = [r for r in small_copies(Store(GALLERY)) if r.learner == "tom"]
ROAD, PENDULUM = (
    next(run for run in TOM if run.env == env) for env in ("road-and-rocks", "inverted-pendulum")
)


@pytest.fixture
def bare(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, show: Show) -> Path:
    """Copies of two runs of the gallery; nothing of them is small enough to be kept."""
    monkeypatch.setattr("tom.record.thin.SMALL", 100)
    for run in (ROAD, PENDULUM):
        export_small(run, tmp_path)
    show(tmp_path)
    return tmp_path


def said(app: AppTest) -> str:
    assert not app.warning
    return "\n".join(part.value for part in [*app.caption, *app.info])


@pytest.mark.usefixtures("bare")
@pytest.mark.parametrize(
    ("view", "part", "run", "lacking"),
    [
        ("attention", "One learner's weights", PENDULUM, "buffer"),
        ("attention", "Every learner on one buffer", PENDULUM, "buffer"),
        ("attention", "One learner's weights", ROAD, "buffer"),
        ("replays", "One episode", PENDULUM, "dynamics model"),
        ("replays", "One episode", PENDULUM, " of 5 evaluations"),
    ],
)
def test_what_was_left_out_is_named(view: str, part: str, run: RunReader, lacking: str) -> None:
    lines = said(draw(view, run=run.run_id, part=part)).splitlines()
    assert any(lacking in line for line in lines)


def test_evaluations_that_were_left_out_are_not_called_missing(tmp_path: Path, show: Show) -> None:
    other = next(run for run in TOM if run.env == PENDULUM.env and run.run_id != PENDULUM.run_id)
    export_small(PENDULUM, tmp_path, without=("evaluations",))
    show(tmp_path)
    words = said(draw("replays"))
    assert "left out" in words.lower()
    assert "yet" not in words
    export_small(other, tmp_path)
    sides = [PENDULUM.run_id, other.run_id]
    words = said(draw("replays", part="Side by side", side=sides))
    assert "left out" in words
    assert "yet" not in words


def test_a_recording_of_sac_has_no_weights(tmp_path: Path, show: Show) -> None:
    (recording,) = (r for r in small_copies(Store(GALLERY)) if r.run_id == "hopper-sac-s0")
    export_small(recording, tmp_path)
    show(tmp_path)
    app = draw("attention", run=recording.run_id)
    assert not figures(app)
    assert LEARNERS_ON_IT in app.info[0].value


def test_a_recording_of_sac_is_weighed_whole_although_it_kept_policies(
    tmp_path: Path, show: Show
) -> None:
    run = shutil.copytree(GALLERY / "hopper-sac-s0", tmp_path / "hopper-sac-s0")
    policy = run / layout.policy(30_000)
    policy.parent.mkdir()
    shutil.copy(run / layout.POLICY, policy)
    show(tmp_path)
    app = on_one_buffer(run=run.name)
    assert app.selectbox(key="weigh policy").value == run.name
    assert len(app.selectbox(key="at").options) == 1


def test_the_table_of_runs_and_the_cards_say_which_is_one(bare: Path) -> None:
    config = bare / ROAD.run_id / layout.CONFIG
    content = json.loads(config.read_text())
    del content["thinned"]
    config.write_text(json.dumps(content))
    copy, whole = info(bare, PENDULUM.run_id), info(bare, ROAD.run_id)
    assert list(overview([copy, whole])["state"]) == ["finished (a small copy)", "finished"]
    assert progress_line(copy).endswith(" steps · a small copy")
    assert progress_line(whole).endswith(" steps")


def test_pages_open_with_ones_own_weighing_run_and_else_with_toms_longest_copy(
    store: Path,
) -> None:
    copies = [run for run in readers.listing(str(GALLERY)).runs if run.small_copy]  # not the demo's
    own = readers.listing(str(store)).runs
    first = min(copies, key=interest_key)
    assert (first.learner, first.preset) == ("tom", "mended")
    assert first.status.env_step == max(
        run.status.env_step for run in copies if (run.learner, run.preset) == ("tom", "mended")
    )
    mine = min([*copies, *own], key=interest_key)
    assert mine in own
    assert has_uneven_weights(mine)
    uniform = [run for run in copies if run.learner == "mle"]
    longest = max(run.status.env_step for run in uniform)
    assert min(uniform, key=interest_key).status.env_step == longest
