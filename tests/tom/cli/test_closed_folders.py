"""Folders of a store that this user may not enter are named, and the others are read."""

import shutil
from pathlib import Path

import pytest

from tom.cli import main

RUN = Path(__file__).parents[3] / "runs/inverted-pendulum-tom-s0-162b7ad0"

pytestmark = pytest.mark.usefixtures("modes_count")


@pytest.fixture
def store(tmp_path: Path) -> Path:
    for name in ("seen-run", "closed-run"):
        shutil.copytree(RUN, tmp_path / name)
    return tmp_path


def test_a_closed_run_is_named_and_the_others_are_read(store: Path, capsys):
    (store / "closed-run").chmod(0)
    capsys.readouterr()
    assert main(["runs", "list", "--store", str(store)]) == 0
    said = capsys.readouterr()
    assert [line.split(":")[0] for line in said.err.splitlines()] == ["closed-run"]
    assert ("seen-run" in said.out, "closed-run" in said.out) == (True, False)
    assert main(["runs", "verify", "--store", str(store)]) == 1
    assert capsys.readouterr().err.count("closed-run: not a run") == 1


def test_a_closed_part_of_a_run_is_named_and_the_others_are_verified(store: Path, capsys):
    (store / "closed-run/digests.json").unlink()  # as of a run that has not ended
    (store / "closed-run/buffer").chmod(0)
    assert main(["runs", "verify", "--store", str(store)]) == 1
    said = capsys.readouterr().out.splitlines()
    assert said[-1] == "2 runs read, 1 with problems"
    assert any(line.startswith("closed-run: buffer") for line in said)
    assert main(["runs", "list", "--store", str(store)]) == 0
