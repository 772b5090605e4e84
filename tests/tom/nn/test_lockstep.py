import threading
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
import torch

from tom.nn.graphs import captured_step
from tom.nn.lockstep import Lockstep, Rank, Work, call, do


class Counter:
    """A subject that counts: what is done to the joint one is seen by its members."""

    device = torch.device("cpu")
    capture: Callable[..., Any] | None = None

    def __init__(self, values: torch.Tensor) -> None:
        self.values = values

    @classmethod
    def joined(cls, counters: "Sequence[Counter]") -> "Counter":
        joint = cls(torch.cat([c.values for c in counters]))
        for counter, part in zip(counters, joint.values.chunk(len(counters)), strict=True):
            counter.values = part
        return joint


@dataclass
class Add(Work):
    rank = Rank.SAC
    subject: Counter
    amount: float
    log: list[int]

    @property
    def kind(self) -> str:
        return "add"

    @classmethod
    def do(cls, works: "Sequence[Add]", subject: Counter) -> None:
        works[0].log.append(len(works))
        subject.values += torch.tensor([w.amount for w in works])


class Early(Add):
    rank = Rank.ACT


def training(
    counter: Counter, amounts: list[float], log: list[int], early: bool = False
) -> Callable[[], float]:
    def train() -> float:
        for amount in amounts:
            if early:
                do(Early(counter, 0.5, log))
            do(Add(counter, amount, log))
        return float(counter.values.sum())

    return train


def counters(n: int) -> list[Counter]:
    return [Counter(torch.zeros(1)) for _ in range(n)]


def test_alone_work_is_done_at_once():
    log: list[int] = []
    (counter,) = counters(1)
    work = Add(counter, 3.0, log)
    assert do(work) is work
    assert float(counter.values) == 3
    assert training(counter, [1, 2], log)() == 6
    assert log == [1, 1, 1]


def test_equal_work_is_done_in_one_go_with_each_ones_result():
    log: list[int] = []
    amounts = [[1.0, 2.0], [10.0, 20.0], [100.0, 200.0]]
    trainings = [training(c, a, log) for c, a in zip(counters(3), amounts, strict=True)]
    assert Lockstep().run(trainings) == [3, 30, 300]
    assert log == [3, 3]


def test_one_that_has_more_to_do_first_is_waited_for():
    log: list[int] = []
    first, second = counters(2)
    both = [training(first, [1, 2], log), training(second, [1, 2], log, early=True)]
    assert Lockstep().run(both) == [3, 4]
    assert log == [1, 2, 1, 2]


def test_members_go_on_by_themselves_where_another_has_ended():
    log: list[int] = []
    first, second = counters(2)
    both = [training(first, [1, 2, 3], log), training(second, [1], log)]
    assert Lockstep().run(both) == [6, 1]
    assert log == [2, 1, 1]


def test_those_who_are_left_are_joined_anew_where_another_has_ended():
    log: list[int] = []
    a, b, c = counters(3)
    first, second, third = (
        training(a, [1, 2, 3], log),
        training(b, [1], log),
        training(c, [5] * 3, log),
    )
    assert Lockstep().run([first, second, third]) == [6, 1, 15]
    assert log == [3, 2, 2]


def test_an_error_ends_its_own_training_alone():
    first, second = counters(2)

    def failing() -> float:
        do(Add(first, 1.0, []))
        raise ArithmeticError("diverged")

    found = Lockstep().run([failing, training(second, [1, 2], [])])
    assert isinstance(found[0], ArithmeticError)
    assert found[1] == 3


@pytest.mark.parametrize("error", [KeyboardInterrupt, ArithmeticError])
def test_an_interrupt_or_an_error_in_shared_work_ends_all_and_each_is_told(
    error: type[BaseException],
):
    told: list[str] = []

    class Broken(Add):
        @classmethod
        def do(cls, works: Sequence[Add], subject: Counter) -> None:
            raise error

    def patient(counter: Counter, name: str) -> Callable[[], None]:
        def train() -> None:
            try:
                while True:
                    do(Add(counter, 1.0, []))
            except BaseException as ended:
                told.append(f"{name} {type(ended).__name__}")
                raise

        return train

    a, b, c = counters(3)
    with pytest.raises(error):
        Lockstep().run([patient(a, "a"), lambda: do(Broken(b, 1.0, [])), patient(c, "c")])
    assert sorted(told) == [f"{name} {error.__name__}" for name in "ac"]


def test_each_member_keeps_the_settings_of_its_own_context():
    """Context variables: what one sets, the others do not see, nor who runs them."""
    seen: list[float] = []

    def train(counter: Counter, how: str) -> Callable[[], None]:
        def steps() -> None:
            with np.errstate(divide="raise") if how == "raise" else nullcontext():
                do(Add(counter, 1.0, []))
                try:
                    seen.append(float(np.float64(1) / np.float64(0)))
                except FloatingPointError:
                    seen.append(-1)

        return steps

    first, second = counters(2)
    with np.errstate(divide="ignore"):
        Lockstep().run([train(first, "raise"), train(second, "as it is")])
    assert seen == [-1, np.inf]


def thread() -> str:
    return threading.current_thread().name


def calling(function: Callable[[], str]) -> Callable[[], str]:
    return lambda: call(function)


def test_calls_of_several_members_have_threads_of_their_own():
    def failing() -> str:
        raise ArithmeticError("fell over")

    found = Lockstep().run([calling(thread), calling(failing), calling(thread)])
    assert isinstance(found[1], ArithmeticError)
    for name in (found[0], found[2]):
        assert isinstance(name, str)
        assert name.startswith("call")


def test_a_call_of_one_alone_stays_in_its_thread():
    assert call(thread) == thread()
    assert Lockstep().run([calling(thread)]) == [thread()]


class Captured(Counter):
    """A counter on a GPU, whose step stands at the memory it was captured with."""

    device = torch.device("cuda")

    def step(self, amount: torch.Tensor) -> None:
        self.values.add_(amount)


@dataclass
class Step(Work):
    rank = Rank.SAC
    subject: Captured
    amount: float
    taken: list[object]

    @property
    def kind(self) -> str:
        return "step"

    @classmethod
    def do(cls, works: "Sequence[Step]", subject: Captured) -> None:
        captured_step(subject)(torch.tensor([w.amount for w in works]))
        works[0].taken.append(subject.capture)


def test_what_was_captured_alone_is_captured_anew_after_having_been_joined():
    """Joining moves the members' tensors: the old capture would write where nobody reads."""
    taken: list[object] = []
    first, second = (Captured(torch.zeros(1)) for _ in range(2))

    def stepping(counter: Captured, amounts: list[float]) -> Callable[[], float]:
        def train() -> float:
            for amount in amounts:
                do(Step(counter, amount, taken))
            return float(counter.values.sum())

        return train

    lockstep = Lockstep()
    assert lockstep.run([stepping(first, [1, 2])]) == [3]
    assert lockstep.run([stepping(first, [4, 8]), stepping(second, [10])]) == [15, 10]
    alone_before, again_before, joined, alone_after = taken
    assert alone_before is again_before
    assert len({alone_before, joined, alone_after}) == 3
