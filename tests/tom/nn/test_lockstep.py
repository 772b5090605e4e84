import threading
from collections.abc import Generator, Sequence
from dataclasses import dataclass

import pytest
import torch

from tom.nn.lockstep import Call, Lockstep, Work, alone, finished


class Counter:
    """A subject that counts: what is done to the joint one is seen by its members."""

    device = torch.device("cpu")

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
    rank = 1
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
    rank = 0


def training(
    counter: Counter, amounts: list[float], log: list[int], early: bool = False
) -> Generator[Work, None, float]:
    for amount in amounts:
        if early:
            yield Early(counter, 0.5, log)
        yield Add(counter, amount, log)
    return float(counter.values.sum())


def counters(n: int) -> list[Counter]:
    return [Counter(torch.zeros(1)) for _ in range(n)]


def test_alone_passes_on_what_is_told_and_returns_the_result():
    log: list[int] = []

    def telling() -> Generator[str | Work, None, float]:
        yield "begin"
        found = yield from training(counters(1)[0], [1, 2], log)
        yield "end"
        return found

    steps = alone(telling())
    assert [next(steps), next(steps)] == ["begin", "end"]
    with pytest.raises(StopIteration) as end:
        next(steps)
    assert end.value.value == 3
    assert finished(training(counters(1)[0], [4], log)) == 4


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
    def failing(counter: Counter) -> Generator[Work, None, float]:
        yield Add(counter, 1.0, [])
        raise ArithmeticError("diverged")

    first, second = counters(2)
    found = Lockstep().run([failing(first), training(second, [1, 2], [])])
    assert isinstance(found[0], ArithmeticError)
    assert found[1] == 3


def test_an_interrupt_closes_all():
    closed: list[str] = []

    def patient(counter: Counter, name: str) -> Generator[Work, None, None]:
        try:
            while True:
                yield Add(counter, 1.0, [])
        finally:
            closed.append(name)

    def interrupted(counter: Counter) -> Generator[Work, None, None]:
        yield Add(counter, 1.0, [])
        raise KeyboardInterrupt

    a, b, c = counters(3)
    with pytest.raises(KeyboardInterrupt):
        Lockstep().run([patient(a, "a"), interrupted(b), patient(c, "c")])
    assert sorted(closed) == ["a", "c"]


def calling(call) -> Generator[Work, None, str]:
    work = Call(call)
    yield work
    return work.result()


def thread() -> str:
    return threading.current_thread().name


def test_calls_of_several_members_have_threads_of_their_own():
    def failing() -> str:
        raise ArithmeticError("fell over")

    found = Lockstep().run([calling(thread), calling(failing), calling(thread)])
    assert isinstance(found[1], ArithmeticError)
    for name in (found[0], found[2]):
        assert isinstance(name, str)
        assert name.startswith("call")


def test_a_call_of_one_alone_stays_in_its_thread():
    assert finished(calling(thread)) == thread()
    assert Lockstep().run([calling(thread)]) == [thread()]


class Captured(Counter):
    """A counter on a GPU, whose step stands at the memory it was captured with."""

    device = torch.device("cuda")

    def step(self, amount: torch.Tensor) -> None:
        self.values.add_(amount)


@dataclass
class Step(Work):
    rank = 1
    subject: Captured
    amount: float
    taken: list[object]

    @property
    def kind(self) -> str:
        return "step"

    @classmethod
    def do(cls, works: "Sequence[Step]", subject: Captured) -> None:
        subject.step(torch.tensor([w.amount for w in works]))
        works[0].taken.append(vars(subject)["step"])


def test_what_was_captured_alone_is_captured_anew_after_having_been_joined():
    """Joining moves the members' tensors: the old capture would write where nobody reads."""
    taken: list[object] = []
    first, second = (Captured(torch.zeros(1)) for _ in range(2))

    def stepping(counter: Captured, amounts: list[float]) -> Generator[Work, None, float]:
        for amount in amounts:
            yield Step(counter, amount, taken)
        return float(counter.values.sum())

    lockstep = Lockstep()
    assert lockstep.run([stepping(first, [1, 2])]) == [3]
    assert lockstep.run([stepping(first, [4, 8]), stepping(second, [10])]) == [15, 10]
    alone_before, again_before, joined, alone_after = taken
    assert alone_before is again_before
    assert len({alone_before, joined, alone_after}) == 3
