"""Many trainings side by side: what each does alone, a fleet does in one go.

A training is a generator. It yields what it has to tell and, where the heavy work is, a piece of
`Work`; when it is asked to go on, that work is done. `alone` does every piece by itself.
`Lockstep.run` waits until all trainings have brought theirs and does equal ones as one, on
networks joined into a stack. A training cannot tell the difference.
"""

import os
from collections import defaultdict
from collections.abc import Callable, Generator, Hashable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from functools import cache
from typing import Any, ClassVar, Generic, TypeVar

import torch

from tom.nn.graphs import graphed

Told = TypeVar("Told")
Result = TypeVar("Result")


class Work:
    """A piece of a training that members of equal `kind` can do in one go.

    Its `subject` is what it moves: networks and their optimisers, with a `step`, a `device`, and
    `joined`, which makes one of many; work that moves no network has none. Where members wait with
    different work, that of the lowest `rank` is done first: the others may be brought the same in
    the meantime.
    """

    rank: ClassVar[int]
    subject: Any

    @property
    def kind(self) -> Hashable:
        raise NotImplementedError

    @classmethod
    def do(cls, works: Sequence[Any], subject: Any) -> None:
        """Do all of them with `subject`, theirs joined in the same order."""
        raise NotImplementedError


class Call(Work, Generic[Result]):
    """Work that is one member's own call and trains no network; in a fleet each has a thread.

    What it takes of the processor must be done without Python's lock, as MuJoCo does, for threads
    to bring something. An error is the member's own: `result` raises it.
    """

    rank = 1
    subject = None

    def __init__(self, call: Callable[[], Result]) -> None:
        self._call = call
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
            self._done.set_result(self._call())
        except Exception as error:  # the others' calls go on
            self._done.set_exception(error)

    def result(self) -> Result:
        """What the call returned, once the work is done."""
        return self._done.result(timeout=0)


@cache
def _threads() -> ThreadPoolExecutor:
    """One a core; torch in them takes no further ones."""
    return ThreadPoolExecutor(len(os.sched_getaffinity(0)), "call", torch.set_num_threads, (1,))


def alone(steps: Generator[Told | Work, None, Result]) -> Generator[Told, None, Result]:
    """A training by itself: its work is done as it comes."""
    lockstep = Lockstep()
    while True:
        try:
            item = next(steps)
        except StopIteration as end:
            return end.value
        if isinstance(item, Work):
            try:
                lockstep.do([item])
            except Exception as error:
                steps.throw(error)  # its record says what ended it
                raise
        else:
            yield item


def finished(steps: Generator[Work, None, Result]) -> Result:
    """The result of something that has nothing to tell, by itself."""
    quiet = alone(steps)
    while True:
        try:
            next(quiet)
        except StopIteration as end:
            return end.value


class Lockstep:
    """Runs trainings side by side; keeps what it has joined."""

    def __init__(self) -> None:
        self._joints: dict[tuple[int, ...], tuple[Sequence[Any], Any]] = {}

    def run(self, trainings: Sequence[Generator[Work, None, Result]]) -> list[Result | Exception]:
        """What each training comes to, or the error that ended it; the others are joined
        anew and go on without it.

        KeyboardInterrupt, and an error in the shared work itself, end all.
        """
        running, waiting = dict(enumerate(trainings)), {}
        results: dict[int, Result | Exception] = {}
        moved: dict[int, set[int]] = defaultdict(set)  # the subjects of each one's work
        try:
            while running:
                for number in [n for n in running if n not in waiting]:
                    try:
                        waiting[number] = next(running[number])
                        moved[number].add(id(waiting[number].subject))
                    except StopIteration as end:
                        results[number] = end.value
                    except Exception as error:  # its own affair, and told to the caller
                        results[number] = error
                    if number in results:
                        del running[number]
                        self._part(moved[number])
                self._do_first(waiting)
        except Exception as error:
            for training in running.values():
                with suppress(Exception):  # the same one again
                    training.throw(error)  # each one's record says what ended it
            raise
        finally:
            for training in running.values():
                training.close()
        return [results[number] for number in range(len(trainings))]

    def _do_first(self, waiting: dict[int, Work]) -> None:
        """Do the work of lowest rank, equal kinds in one go."""
        rank = min((work.rank for work in waiting.values()), default=0)
        kinds: dict[Hashable, list[Work]] = defaultdict(list)
        for number in sorted(n for n, work in waiting.items() if work.rank == rank):
            work = waiting.pop(number)
            kinds[type(work), work.kind].append(work)
        for works in kinds.values():
            self.do(works)

    def do(self, works: Sequence[Work]) -> None:
        """Do works of one kind, in one go where they can be."""
        for some, subject in self._joined(works):
            type(works[0]).do(some, subject)

    def _joined(self, works: Sequence[Work]) -> Iterator[tuple[Sequence[Work], Any]]:
        """The works with their subjects' joint, or one by one where the others are elsewhere."""
        subjects = [work.subject for work in works]
        if subjects[0] is None:
            yield works, None
            return
        key = tuple(id(subject) for subject in subjects)
        if key not in self._joints and len(key) > 1 and self._among_others(key):
            for work in works:
                yield from self._joined([work])
            return
        if key not in self._joints:
            joint = self._join(subjects) if len(key) > 1 else subjects[0]
            vars(joint).pop("step", None)  # a copy of a member that was captured by itself
            if joint.device.type == "cuda":
                joint.step = graphed(joint.step)
            self._joints[key] = subjects, joint  # the subjects too: an id lives as they do
        yield works, self._joints[key][1]

    def _join(self, subjects: Sequence[Any]) -> Any:
        """One subject of many; what was captured of one alone stands at tensors it has left."""
        self._part({id(subject) for subject in subjects})
        return type(subjects[0]).joined(subjects)

    def _part(self, subjects: set[int]) -> None:
        """Forget what any of these was joined to, and at once the memory of its capture."""
        for key in [key for key in self._joints if subjects & set(key)]:
            _, joint = self._joints.pop(key)
            vars(joint).pop("step", None)

    def _among_others(self, key: tuple[int, ...]) -> bool:
        """Whether some of them are joined with more: joining them anew would part those."""
        return any(len(known) > 1 and set(known) & set(key) for known in self._joints)
