"""The pages in a store with folders that this user may not enter."""

import os
import shutil
from pathlib import Path

import pytest
from studio_pages import draw, set_links
from studio_runs import PENDULUM_TOM, ROAD_TOM

from app.__main__ import _readable
from app.data import readers
from app.links import Links
from app.router import VIEWS

PAGES = [view.__name__.rpartition(".")[2] for view in VIEWS]
OF_PARTS = [page for page in PAGES if page not in ("compare", "studies")]
PARTS = ("buffer", "checkpoint", "episodes", "fields", "policies", "weights")
LISTED = 0o444
"""the mode of a folder whose names can be listed and whose files cannot be opened"""

pytestmark = pytest.mark.usefixtures("modes_count")


@pytest.fixture
def own(store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of the store that the pages show, in which folders may be closed."""
    path = Path(shutil.copytree(store, tmp_path / "store", copy_function=os.link))
    set_links(Links(store=str(path), key="key"), monkeypatch)
    return path


@pytest.mark.parametrize("page", PAGES)
def test_a_closed_run_is_named_and_the_others_are_shown(own: Path, page: str):
    (own / PENDULUM_TOM).chmod(0)
    assert _readable(own) == own
    found = readers.listing(str(own))
    assert len(found.runs) == 4
    assert [text.split(":")[0] for text in found.problems] == [PENDULUM_TOM]
    draw(page, run=PENDULUM_TOM)


@pytest.mark.parametrize(
    ("part", "mode"),
    [*((part, LISTED) for part in PARTS), *((p, 0) for p in ("buffer", "checkpoint", "weights"))],
)
@pytest.mark.parametrize("page", OF_PARTS)
def test_a_closed_part_of_a_run_leaves_the_pages_whole(own: Path, page: str, part: str, mode: int):
    for run in (PENDULUM_TOM, ROAD_TOM):
        (own / run / part).chmod(mode)
        draw(page, run=run)
