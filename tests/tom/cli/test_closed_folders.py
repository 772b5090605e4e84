"""Folders of a store that this user may not enter are named, and the others are read."""

import shutil
from pathlib import Path

import pytest

from tom.cli import main

TRAIN = ["train", "--env", "inverted-pendulum", "--preset", "smoke", "--no-rerun", "--steps", "250"]
PARTS = ("buffer", "checkpoint", "weights")

pytestmark = pytest.mark.usefixtures("modes_count")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("made")
    words = ["--learner", "tom", "--store", str(path), "--run-id", "seen-run"]
    assert main([*TRAIN, *words]) == 0
    shutil.copytree(path / "seen-run", path / "closed-run")
    return path


@pytest.fixture
def store(made: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(made, tmp_path / "store"))


@pytest.mark.parametrize(
    ("words", "code"),
    [
        (["list"], 0),
        (["verify"], 1),
        (["size"], 0),
        (["export"], 0),
        (["export", "--small"], 0),
        (["prune", "--keep", "0"], 0),
    ],
)
def test_a_closed_run_is_named_and_the_others_are_read(
    store: Path, tmp_path: Path, capsys, words: list[str], code: int
):
    out = tmp_path / "out"
    (store / "closed-run").chmod(0)
    more = ["--out", str(out)] if words[0] == "export" else []
    capsys.readouterr()
    assert main(["runs", *words, *more, "--store", str(store)]) == code
    said = capsys.readouterr()
    if words == ["verify"]:
        assert said.out.count("closed-run: no run") == 1
        return
    assert [line.split(":")[0] for line in said.err.splitlines()] == ["closed-run"]
    told = said.out + "".join(path.name for path in (out.iterdir() if out.exists() else ()))
    assert ("seen-run" in told, "closed-run" in told) == (True, False)


@pytest.mark.parametrize("part", PARTS)
def test_a_closed_part_of_a_run_is_named_and_the_others_are_verified(
    store: Path, capsys, part: str
):
    (store / "closed-run/digests.json").unlink()  # as of a run that has not ended
    (store / "closed-run" / part).chmod(0)
    assert main(["runs", "verify", "--store", str(store)]) == 1
    said = capsys.readouterr().out.splitlines()
    assert said[-1] == "2 runs read, 1 with problems"
    assert any(line.startswith(f"closed-run: {part}") for line in said)
    for words in (["list"], ["size"], ["prune", "--keep", "0"]):
        assert main(["runs", *words, "--store", str(store)]) == 0
