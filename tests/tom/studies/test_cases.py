"""A study's cases: computed once, in order, and found again by the code that computed them."""

import os
import signal
from argparse import Namespace
from collections.abc import Sequence
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from tom.analysis.weighing import Weighed
from tom.envs import user_code
from tom.studies import study as module
from tom.studies.progression import Result
from tom.studies.road import CaseResult
from tom.studies.study import FOLDER, compute, load_outcome, save_outcome
from tom.studies.tabular_estimates import Estimate


@dataclass(frozen=True)
class Inner:
    """A dataclass in an outcome."""

    value: float
    metrics: dict[str, float]


@dataclass(frozen=True)
class Step:
    """Write one letter into `log`; `fatal` kills the process instead."""

    letter: str
    log: Path
    fatal: bool = False


@dataclass(frozen=True)
class Written:
    """What a step came to, with the kinds of values that outcomes have."""

    text: str
    step: tuple[Inner, ...]
    array: NDArray[np.float32]
    missing: NDArray[np.int64] | None = None


def write(step: Step) -> Written:
    if step.fatal:
        os.kill(os.getpid(), signal.SIGKILL)
    with step.log.open("a") as file:
        file.write(step.letter)
    inner = Inner(float("nan"), {"a": 0.1})
    return Written(step.letter * 2, (inner,), np.arange(3, dtype=np.float32))


def carried_out(steps: Sequence[Step], folder: Path) -> list[Written]:
    return compute(Namespace(out=folder, jobs=1), write, steps, lambda one: one.text)


@pytest.mark.slow
def test_what_is_finished_survives_a_killed_process(tmp_path: Path):
    log = tmp_path / "log"
    a, b, c = (Step(letter, log) for letter in "abc")
    with pytest.raises(BrokenProcessPool):
        carried_out([a, b, Step("x", log, fatal=True), c], tmp_path)
    assert log.read_text() == "ab"
    again = carried_out([c, b, a], tmp_path)
    assert [one.text for one in again] == ["cc", "bb", "aa"]
    for one in again:
        assert one.array.tolist() == [0, 1, 2]
        assert one.array.dtype == np.float32
        assert one.step[0].metrics == {"a": 0.1}
        assert np.isnan(one.step[0].value)
        assert one.missing is None
    assert log.read_text() == "abc"
    assert len(list((tmp_path / FOLDER).iterdir())) == 3


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


def test_the_packages_and_files_that_the_user_named_are_code(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    (tmp_path / "own_package" / "envs").mkdir(parents=True)
    for name in ("__init__.py", "envs/__init__.py", "envs/task.py"):
        (tmp_path / "own_package" / name).touch()
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(user_code, "_USER_MODULES", {})
    before = module.code_hash()
    user_code.import_named("time", "--env time:Task-v0")  # has no file
    assert module.code_hash() == before
    user_code.import_named("own_package.envs", "--env own_package.envs:Task-v0")
    named = module.code_hash()
    (tmp_path / "own_package/envs/task.py").write_text("x = 1")
    assert len({before, named, module.code_hash()}) == 3


WEIGHTS = np.linspace(0, 2, 5, dtype=np.float32)
EXACT = np.linspace(0, 2, 5)
OUTCOMES = (
    CaseResult({"name": "tom", "seed": 0}, [(0, -1.5)], np.zeros((5, 2), np.float32), WEIGHTS),
    Estimate({"variant": "exact", "uniform": (0.1, 0.3), "l1": None}, *[EXACT] * 3),
    Result(
        "hopper-s0", "hopper", 2, "own", "exact",
        (Weighed("tom", 0, WEIGHTS, None, {"weights/ess": np.float64(0.5)}, (("a", "b"),), None),),
    ),
    {"rival": "mle", "seed": 0, "ess": 0.5, "policy": np.float64(0.1)},
)  # fmt: skip


@pytest.mark.parametrize("outcome", OUTCOMES, ids=lambda outcome: type(outcome).__name__)
def test_the_outcomes_of_all_studies_can_be_kept(tmp_path: Path, outcome: object):
    save_outcome(outcome, tmp_path / "case.pt")
    assert repr(load_outcome(tmp_path / "case.pt", type(outcome))) == repr(outcome)
