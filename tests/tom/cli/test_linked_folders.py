"""The folders beside the runs of a store are followed to no other place, whatever is done."""

import shutil
from pathlib import Path

import pytest

from tom.cli import main

TASK = ["--env", "inverted-pendulum", "--preset", "smoke", "--steps", "250"]
WEIGH = ["weigh", "run", "--policy", "run", "--learner", "mle", "--seeds", "0", "--footprint", "50"]
BRUSH = [
    "brush",
    "run",
    "--rows",
    "../rows",
    "--step",
    "200",
    "--weighing",
    "weighed:mle-s0",
    "--out",
    "../brushed",
]
BESIDE = ("weighings", "studies", ".views", ".sweep", ".trash")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store with a run, a weighing and a run in the trash."""
    path = tmp_path_factory.mktemp("made")
    train = ["train", *TASK, "--learner", "tom", "--no-rerun", "--store", str(path)]
    assert main([*train, "--run-id", "run"]) == 0
    shutil.copytree(path / "run", path / "gone")
    assert main(["runs", "trash", "gone", "--store", str(path)]) == 0
    assert main([*WEIGH, "--store", str(path), "--out", str(path / "weighings/weighed")]) == 0
    for name in BESIDE:
        (path / name).mkdir(exist_ok=True)
    return path


@pytest.fixture
def store(made: Path, tmp_path: Path) -> Path:
    """A store whose every folder beside the runs leads to another place."""
    path, outside = tmp_path / "store", tmp_path / "outside"
    shutil.copytree(made, outside)
    path.mkdir()
    (outside / "run").rename(path / "run")
    for name in BESIDE:
        (path / name).symlink_to(outside / name)
    return path


def written(folder: Path) -> dict[Path, float]:
    return {path: path.stat().st_mtime_ns for path in (folder, *folder.rglob("*"))}


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (WEIGH, "weighings"),
        (BRUSH, "weighings"),
        (["sweep", *TASK, "--learner", "mle", "--seeds", "1"], ".sweep"),
        (["sweep", *TASK, "--learner", "mle", "--seeds", "1", "--engine", "slurm"], ".sweep"),
        (["runs", "trash", "run"], ".trash"),
        (["runs", "trash"], ".trash"),
        (["runs", "restore", "gone"], ".trash"),
    ],
)
def test_nothing_is_written_through_a_link(
    store: Path, tmp_path: Path, capsys, monkeypatch, words: list[str], named: str
):
    (tmp_path / "rows").write_text("1\n2\n")
    monkeypatch.chdir(store)
    before = written(tmp_path / "outside")
    assert main([*words, "--store", str(store)]) == 2
    said = capsys.readouterr()
    assert f"{named} is a link" in said.err
    assert said.err.count("\n") == 1
    assert written(tmp_path / "outside") == before
    assert (store / "run/config.json").exists()
