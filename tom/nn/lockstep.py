"""Many trainings side by side, whose heavy work is done together.

A training is plain code. For heavy work it calls `do` with a piece of `Work`; when the call
returns, the work is done. A single training does it at once. In a fleet every training has its own
stack (a greenlet): `do` suspends it until all trainings have brought their work, and work of equal
kind is done together, on networks joined into a stack. A training cannot tell the difference.
"""

import os
from collections import defaultdict
from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from contextvars import copy_context
from enum import IntEnum
from functools import cache
from typing import Any, ClassVar, Generic, TypeVar

import torch
from greenlet import getcurrent, greenlet

Result = TypeVar("Result")


class Rank(IntEnum):
    """If members wait with different kinds of work, the lowest rank is done first, because its
    members may then bring the same kind of work as the others."""

    ACT = 0
    CALL = 1
    DISCRIMINATOR = 2
    DUAL = 3
    FIT = 4
    SAC = 5


class Work:
    """A piece of a training that can be done together with others of equal `kind`.

    Its `subject` is the network that it trains (`Stepped`), whose `joined` makes one of many; work
    that trains no network has none.
    """

    rank: ClassVar[Rank]
    subject: Any

    @property
    def kind(self) -> Hashable:
        raise NotImplementedError

    @classmethod
    def do(cls, works: Sequence[Any], subject: Any) -> None:
        """Do all works with `subject`, which joins their subjects in the same order."""
        raise NotImplementedError


AnyWork = TypeVar("AnyWork", bound=Work)


def do(work: AnyWork) -> AnyWork:
    """Do the work at once, or in a fleet together with that of other members; returns the work."""
    member = getcurrent()
    if isinstance(member, _Member):
        member.bring(work)
    else:
        type(work).do([work], work.subject)
    return work


def call(function: Callable[[], Result]) -> Result:
    """The result of `function`; in a fleet the members' calls run in parallel (see `Call`)."""
    return do(Call(function)).result()


class Call(Work, Generic[Result]):
    """A function call of one member that trains no network; in a fleet each call has a thread.

    Threads only help if the function releases Python's lock, as MuJoCo does. An error belongs to
    the member: `result` raises it.
    """

    rank = Rank.CALL
    subject = None

    def __init__(self, function: Callable[[], Result]) -> None:
        self._function = function
        self._done: Future[Result] = Future()

    @property
    def kind(self) -> Hashable:
        return None

    @classmethod
    def do(cls, works: "Sequence[Call[Any]]", subject: None) -> None:
        if len(works) == 1:
            works[0].run()
        else:
            list(_threads().map(cls.run, works))

    def run(self) -> None:
        try:
            self._done.set_result(self._function())
        except Exception as error:  # the others' calls go on
            self._done.set_exception(error)

    def result(self) -> Result:
        """What the call returned, once the work is done."""
        return self._done.result(timeout=0)


@cache
def _threads() -> ThreadPoolExecutor:
    """One thread per core; torch starts no further ones in them."""
    return ThreadPoolExecutor(len(os.sched_getaffinity(0)), "call", torch.set_num_threads, (1,))


class _Member(greenlet):
    """A training on its own stack; a switch resumes it until it brings its next work."""

    def __init__(self, training: Callable[[], Any]) -> None:
        super().__init__(training)
        self.gr_context = copy_context()
        self.moved: dict[int, Any] = {}  # the subjects of its work, by id

    def bring(self, work: Work) -> None:
        """Suspend the training with `work` until it is done."""
        assert self.parent is not None
        self.parent.switch(work)


class Lockstep:
    """Runs trainings side by side; keeps the joined networks."""

    def __init__(self) -> None:
        self._joints: dict[tuple[int, ...], tuple[Sequence[Any], Any]] = {}

    def run(self, trainings: Sequence[Callable[[], Result]]) -> list[Result | Exception]:
        """The result of each training, or the error that ended it; the others are joined
        again and go on without it.

        KeyboardInterrupt, or an error in the shared work itself, ends all.
        """
        running = {number: _Member(training) for number, training in enumerate(trainings)}
        waiting: dict[int, Work] = {}
        results: dict[int, Result | Exception] = {}
        try:
            while running:
                for number in [n for n in running if n not in waiting]:
                    member = running[number]
                    brought: Any  # work, or at its end the training's result
                    try:
                        brought = member.switch()
                    except Exception as error:  # ends only this training; the caller gets it
                        brought = error
                    if member.dead:
                        results[number] = brought
                        del running[number]
                        self._part(member.moved)
                        _forget_captures(member.moved.values())
                    else:
                        waiting[number] = brought
                        member.moved[id(brought.subject)] = brought.subject
                self._do_first(waiting)
        except BaseException as error:
            for member in running.values():
                with suppress(BaseException):  # the member raises the same error again
                    member.throw(error)  # so that each record says what ended it
            raise
        return [results[number] for number in range(len(trainings))]

    def _do_first(self, waiting: dict[int, Work]) -> None:
        """Do the work of the lowest rank, equal kinds together."""
        rank = min((work.rank for work in waiting.values()), default=None)
        kinds: dict[Hashable, list[Work]] = defaultdict(list)
        for number in sorted(n for n, work in waiting.items() if work.rank == rank):
            work = waiting.pop(number)
            kinds[type(work), work.kind].append(work)
        for works in kinds.values():
            self.do(works)

    def do(self, works: Sequence[Work]) -> None:
        """Do works of one kind, together if possible."""
        for some, subject in self._joined(works):
            type(works[0]).do(some, subject)

    def _joined(self, works: Sequence[Work]) -> Iterator[tuple[Sequence[Work], Any]]:
        """The works with their joined subject, or one by one if part of a joint is not waiting."""
        subjects = [work.subject for work in works]
        if len(works) == 1 or subjects[0] is None:
            yield works, subjects[0]
            return
        key = tuple(id(subject) for subject in subjects)
        if key not in self._joints and self._among_others(key):
            for work in works:
                yield [work], work.subject
            return
        if key not in self._joints:
            self._joints[key] = subjects, self._join(subjects)  # kept: their ids are keys
        yield works, self._joints[key][1]

    def _join(self, subjects: Sequence[Any]) -> Any:
        """One subject of many; captures of the single ones refer to old tensors and are dropped."""
        self._part([id(subject) for subject in subjects])
        _forget_captures(subjects)
        return type(subjects[0]).joined(subjects)

    def _part(self, subjects: Iterable[int]) -> None:
        """Drop all joints that contain one of these, and free the memory of their captures."""
        for key in [key for key in self._joints if not set(key).isdisjoint(subjects)]:
            _forget_captures([self._joints.pop(key)[1]])

    def _among_others(self, key: tuple[int, ...]) -> bool:
        """Whether some of them are joined with others, which a new joint would separate."""
        return any(set(known) & set(key) for known in self._joints)


def _forget_captures(subjects: Iterable[Any]) -> None:
    for subject in subjects:
        if subject is not None:
            subject.capture = None
