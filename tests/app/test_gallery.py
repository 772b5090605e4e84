"""The gallery in runs/: whole, small, told of in its README; its statistics leave SAC out."""

import shutil
from pathlib import Path

import pytest
from studio_pages import Show, draw

from app.data import studies
from app.views.curves.numbers import NO_SAC
from tom.record import Store
from tom.record.files import size_of
from tom.record.integrity import verify
from tom.record.layout import STUDIES
from tom.reports.index import index, small_copies
from tom.reports.report import run_hours
from tom.reports.weighing_files import of_run

RUNS = Path(__file__).parents[2] / "runs"
README = RUNS / "README.md"
BYTES = 30_000_000

COPIES = small_copies(Store(RUNS))
WEIGHINGS = [path for run in COPIES for path in of_run(RUNS, run.run_id)]


@pytest.fixture
def shown(tmp_path: Path, show: Show) -> None:
    """Pages show the gallery alone, without what else lies in runs/."""
    for path in (*(run.path for run in COPIES), *WEIGHINGS):
        shutil.copytree(path, tmp_path / path.relative_to(RUNS))
    show(tmp_path)


def test_every_run_is_whole_and_says_how_it_was_made() -> None:
    assert {run.run_id: verify(run) for run in COPIES if verify(run)} == {}
    for run in COPIES:
        assert run.status.state == "finished", run.run_id
        assert str(run.config["command"]).startswith("tom "), run.run_id
        assert len(str(run.config["git_commit"])) == 40, run.run_id  # no "-dirty" behind it
        assert run.config["versions"]["torch"]
        assert run_hours(run) > 0


def test_its_readme_is_what_the_command_writes() -> None:
    assert README.read_text() == index(COPIES, WEIGHINGS)


def test_it_is_small() -> None:
    of_runs = [*(run.path for run in COPIES), *WEIGHINGS]
    assert sum(size_of(path) for path in [*of_runs, RUNS / STUDIES, README]) < BYTES


def test_the_recordings_that_its_studies_measured_say_how_to_make_them_again() -> None:
    (study,) = [one for one in studies.listing(RUNS / STUDIES) if one.name == "footprint"]
    named = study.origin["runs"].split(", ")
    commands = {run.run_id: str(run.config["command"]) for run in COPIES if run.run_id in named}
    assert set(commands) == set(named)
    recorded = [command for command in commands.values() if command.startswith("tom record-sac ")]
    assert len(recorded) == 6


def test_its_studies_say_what_was_found_and_by_which_command() -> None:
    found = studies.listing(RUNS / STUDIES)
    assert {study.name for study in found} >= {"footprint", "returns"}
    for study in found:
        assert study.claim, study.name
        assert study.findings, study.name
        assert study.figures, study.name
        made_by = study.name.partition("-")[0]  # returns-apart-40000 is of `tom reproduce returns`
        assert study.origin["command"].startswith(f"tom reproduce {made_by}"), study.name


@pytest.mark.usefixtures("shown")
def test_statistics_compare_no_recording_of_sac() -> None:
    app = draw("curves", part="Statistics", task="walker2d")
    assert NO_SAC in [caption.value for caption in app.caption]
    assert not any("nothing was recorded" in caption.value for caption in app.caption)
    assert not any("SAC" in name for name in app.dataframe[0].value["group"])
