"""The pages in a store whose folders beside the runs are links to another place."""

import json
import os
import shutil
from pathlib import Path

import pytest
from studio_pages import draw, set_links
from studio_runs import PENDULUM_TOM

from app.data import readers, studies, weighings
from app.links import Links
from app.parts import shortlinks
from app.router import VIEWS
from tom.errors import UserError
from tom.record import Store, layout, manage
from tom.reports.report import Report, write_report
from tom.reports.weighing_files import REPORT

PAGES = [view.name for view in VIEWS]
TRASHED = "pendulum-mle-0"
CODE = "56de132e"
"""of the short link to `compare?env=hopper`"""


@pytest.fixture
def own(store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A store with a weighing, a study, a short link and a run in the trash."""
    path = Path(shutil.copytree(store, tmp_path / "store", copy_function=os.link))
    manage.trash(Store(path), TRASHED)
    weighed, study = path / "weighings/weighed", path / "studies/shipped"
    weighed.mkdir(parents=True)
    report = {"data": PENDULUM_TOM, "policy": PENDULUM_TOM, "rows": 0, "results": []}
    (weighed / REPORT).write_text(json.dumps(report))
    study.mkdir(parents=True)
    write_report(Report("shipped", "a claim", ["found"]), study)
    assert shortlinks.save(path, "compare", "env=hopper") == CODE
    set_links(Links(store=str(path), key="key"), monkeypatch)
    return path


def shown(store: Path) -> list[bool]:
    """Whether the pages find the weighing, the study, the run in the trash and the short link."""
    return [
        weighings.weighed(str(store)) == {PENDULUM_TOM},
        studies.report("shipped", *studies.folders(store)) is not None,
        readers.trashed(store) == [TRASHED],
        shortlinks.target(store, CODE) is not None,
    ]


def test_what_lies_behind_a_link_is_not_shown_and_not_written(own: Path, tmp_path: Path):
    assert shown(own) == [True] * 4
    assert readers.listing(str(own)).problems == ()
    (tmp_path / "outside").mkdir()
    for name in layout.BESIDE_RUNS:
        (own / name).mkdir(exist_ok=True)
        (own / name).rename(tmp_path / "outside" / name)
        (own / name).symlink_to(tmp_path / "outside" / name)
    assert shown(own) == [False] * 4
    problems = readers.listing(str(own)).problems
    assert len(problems) == len(layout.BESIDE_RUNS)
    assert all(any(name in problem for problem in problems) for name in layout.BESIDE_RUNS)
    with pytest.raises(UserError, match="link"):
        shortlinks.save(own, "compare", "env=walker2d")
    assert [path.stem for path in (tmp_path / "outside/.views").iterdir()] == [CODE]
    for page in PAGES:
        draw(page, run=TRASHED)
    draw("compare", show="Runs")


@pytest.mark.usefixtures("modes_count")
def test_what_may_not_be_entered_is_not_shown(own: Path):
    for name in layout.BESIDE_RUNS:
        (own / name).mkdir(exist_ok=True)
        (own / name).chmod(0)
    assert shown(own) == [False] * 4
    for page in PAGES:
        draw(page, run=TRASHED)
    draw("compare", show="Runs")
