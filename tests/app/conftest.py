"""A store of real runs, recorded once for all of the studio's tests."""

import fcntl
import os
import shutil
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import streamlit as st
from streamlit.components.v2 import manifest_scanner
from streamlit.runtime.context import ContextProxy
from studio_pages import Show, set_links
from studio_runs import RUNS

from app.guard import KEY
from app.links import Links
from tom.record.store import Store
from tom.training.presets import resolve
from tom.training.run import train


@pytest.fixture(scope="session")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The runs; made by whichever worker comes first."""
    base = tmp_path_factory.getbasetemp()
    # The workers of a session have a folder each, in one that they share.
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "studio"
    folder.mkdir(exist_ok=True)
    with (folder / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (folder / "complete").exists():
            _record(folder / "store")
            (folder / "complete").touch()
    return folder / "store"


def _record(path: Path) -> None:
    for run_id, env, learner, values in RUNS:
        config = resolve(env, learner, "smoke", {**values, "matmul": "default"})
        train(config, Store(path), run_id, rerun=env != "road-and-rocks" or learner == "tom")


@pytest.fixture(scope="session", autouse=True)
def packages_are_looked_through_once() -> None:
    """For each page that it draws AppTest reads what every installed package says of itself."""
    manifest_scanner.scan_component_manifests = cache(manifest_scanner.scan_component_manifests)


@pytest.fixture(autouse=True)
def pages_are_asked_for_with_a_key(monkeypatch: pytest.MonkeyPatch) -> None:
    """AppTest draws a page for no request, so it has no headers of its own."""
    monkeypatch.setattr(ContextProxy, "headers", {KEY: "key"})


@pytest.fixture
def show(monkeypatch: pytest.MonkeyPatch) -> Iterator[Show]:
    def show(store: Path, key: str = "key", **more: Any) -> None:
        set_links(Links(store=str(store), key=key, **more), monkeypatch)

    yield show
    st.cache_data.clear()
    st.cache_resource.clear()


@pytest.fixture
def studio(store: Path, show: Show) -> None:
    """Pages show the recorded runs; no other server is there."""
    show(store)


@pytest.fixture
def own(store: Path, tmp_path: Path, show: Show) -> Path:
    """A copy of the store that a test may write to; pages show it."""
    path = shutil.copytree(store, tmp_path / "own")
    show(path)
    return path
