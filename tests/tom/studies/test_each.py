"""A study's cases: computed once, in order, and found again by the code that computed them."""

import os
import signal
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path

import pytest

from tom.studies import each as module
from tom.studies.each import FOLDER, each


@dataclass(frozen=True)
class Step:
    """Write one letter into `log`; `fatal` kills the process instead."""

    letter: str
    log: Path
    fatal: bool = False


def write(step: Step) -> str:
    if step.fatal:
        os.kill(os.getpid(), signal.SIGKILL)
    with step.log.open("a") as file:
        file.write(step.letter)
    return step.letter * 2


def test_what_is_finished_survives_a_killed_process(tmp_path: Path):
    log = tmp_path / "log"
    a, b, c = (Step(letter, log) for letter in "abc")
    with pytest.raises(BrokenProcessPool):
        list(each(write, [a, b, Step("x", log, fatal=True), c], 1, tmp_path))
    assert log.read_text() == "ab"
    assert list(each(write, [c, b, a], 1, tmp_path)) == ["cc", "bb", "aa"]
    assert log.read_text() == "abc"
    assert len(list((tmp_path / FOLDER).iterdir())) == 3


def test_other_code_computes_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    log = tmp_path / "log"
    assert list(each(write, [Step("a", log)], 1, tmp_path)) == ["aa"]
    monkeypatch.setattr(module, "code_hash", lambda: "other")
    assert list(each(write, [Step("a", log)], 1, tmp_path)) == ["aa"]
    assert log.read_text() == "aa"


def test_the_hash_of_the_code_is_of_its_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    before = module.code_hash()
    assert before == module.code_hash()
    copy = tmp_path / "tom" / "studies"
    copy.mkdir(parents=True)
    (copy / "each.py").write_text("")
    with monkeypatch.context() as other:
        other.setattr(module, "versions", lambda: {"torch": "0"})
        assert module.code_hash() != before
    monkeypatch.setattr(module, "__file__", str(copy / "each.py"))
    empty = module.code_hash()
    (copy / "each.py").write_text("x")
    assert len({before, empty, module.code_hash()}) == 3
