"""One studio and one browser for the tests of a module, over runs that they may change."""

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from studio_browser import DRAWN_S, Visit, studio_and_browser

from app.data import trainings
from app.links import Links
from tom.record.store import Store

if TYPE_CHECKING:
    from playwright.sync_api import Browser


@pytest.fixture(scope="module")
def own_store(tmp_path_factory: pytest.TempPathFactory, store: Path) -> Path:
    """A copy of the recorded runs that the visitors may change."""
    path = tmp_path_factory.mktemp("visitor") / "store"
    shutil.copytree(store, path)
    return path


@pytest.fixture(scope="module")
def opened(own_store: Path) -> Iterator[tuple[Links, "Browser"]]:
    with studio_and_browser(own_store) as opened:
        yield opened


@pytest.fixture
def no_training_left(own_store: Path) -> Iterator[None]:
    yield
    for run in Store(own_store).runs():
        if run.status.alive:
            trainings.stop(Store(own_store), run.run_id)


@pytest.fixture
def visit(own: Path) -> Iterator[Visit]:
    """A tab of a studio of its own, whose runs it may change."""
    with studio_and_browser(own) as (links, browser):
        page = browser.new_page(viewport={"width": 1280, "height": 1000})
        page.set_default_timeout(1000 * DRAWN_S)
        yield Visit(page, links)
