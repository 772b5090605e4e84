"""Runs that are taken up with other versions, other settings, or another learner."""

from pathlib import Path

import pytest
from common import change
from faults import config, stopped
from same_records import assert_same_record

from tom.cli import main
from tom.record import RunReader, Store
from tom.record.writer import RunWriter
from tom.training.resume import resume
from tom.training.run import train

pytestmark = pytest.mark.fault


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("made") / "store"
    stopped(Store(path), 130, learner="tom")
    train(config("tom"), Store(path), "whole", rerun=False)
    return path


def made_with(run: RunReader, package: str, other: str) -> None:
    """Another version of a package stands in the run's config.json."""
    change(run.path / "config.json", versions=run.config["versions"] | {package: other})


@pytest.mark.quick
@pytest.mark.parametrize(
    ("package", "version"),
    [("torch", "2.12.9"), ("numpy", "1.26.4")],
)
def test_another_version_of_what_decides_the_results__is_refused_until_it_is_accepted(
    store: Store, package: str, version: str, capsys: pytest.CaptureFixture[str]
):
    made_with(store.run("a"), package, version)
    before = {path: path.read_bytes() for path in store.path.rglob("*") if path.is_file()}
    words = ["train", "--resume", "a", "--no-rerun", "--store", str(store.path)]
    assert main(words) == 2
    error = capsys.readouterr().err
    assert f"{package} {version} then" in error
    assert "--accept-versions" in error
    assert error.count("\n") == 1
    assert {p: p.read_bytes() for p in store.path.rglob("*") if p.is_file()} == before
    assert main([*words, "--accept-versions"]) == 0
    assert f"{package} {version} then" in capsys.readouterr().err
    done = store.run("a")
    assert any(f"{package} {version} then" in text for text in done.status.warnings)
    assert_same_record(store.run("whole"), done)
    resume(store, "a", steps=250, rerun=False)  # the versions of the last resume count


@pytest.mark.parametrize("package", ["python", "numpy", "tom-studio"])
def test_another_version_of_what_should_not_matter__is_a_warning(store: Store, package: str):
    major, minor, *_ = store.run("a").config["versions"][package].split(".")
    made_with(store.run("a"), package, f"{major}.{minor}.99")
    done = resume(store, "a", rerun=False)
    assert any(f"until here: {package}" in text for text in done.status.warnings)
    assert_same_record(store.run("whole"), done)


def test_killed_right_after_a_resume_begins__the_status_says_the_step_and_the_return(
    store: Store, monkeypatch: pytest.MonkeyPatch
):
    """What is on the disk when the record is about to be rewound."""
    before, seen = store.run("a").status, []

    def killed(self: RunWriter, mark: object) -> None:
        seen.append(RunReader(self.path).status)
        raise KeyboardInterrupt

    monkeypatch.setattr(RunWriter, "rewind", killed)
    with pytest.raises(KeyboardInterrupt):
        resume(store, "a", rerun=False)
    [status] = seen
    assert (status.state, status.env_step, status.last_return) == (
        "running",
        before.env_step,
        before.last_return,
    )
    assert isinstance(before.last_return, float)
