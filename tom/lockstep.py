"""Many trainings side by side: what each does alone, a fleet does in one go.

A training is a generator. It yields what it has to tell and, where the heavy work is, a piece of
`Work`; when it is asked to go on, that work is done. `alone` does every piece by itself.
`Lockstep.run` waits until all trainings have brought theirs and does equal ones as one, on
networks joined into a stack. A training cannot tell the difference.
"""

from collections import defaultdict
from collections.abc import Generator, Hashable, Iterator, Sequence
from typing import Any, ClassVar, Protocol, Self, TypeVar, runtime_checkable

import torch

from tom.graphs import graphed

Told = TypeVar("Told")
Result = TypeVar("Result")


class Subject(Protocol):
    """What work moves: networks and their optimisers. Many can be joined into one."""

    step: Any
    device: torch.device

    @classmethod
    def joined(cls, subjects: Sequence[Any]) -> Any: ...


@runtime_checkable
class Work(Protocol):
    """A piece of a training that members of equal `kind` can do in one go.

    Where members wait with different work, that of the lowest `rank` is done first: the others
    may be brought the same in the meantime.
    """

    rank: ClassVar[int]
    subject: Any

    @property
    def kind(self) -> Hashable: ...

    @classmethod
    def do(cls, works: Sequence[Self], subject: Any) -> None:
        """Do all of them with `subject`, theirs joined in the same order."""
        ...


def alone(steps: Generator[Told | Work, None, Result]) -> Generator[Told, None, Result]:
    """A training by itself: its work is done as it comes."""
    while True:
        try:
            item = next(steps)
        except StopIteration as end:
            return end.value
        if isinstance(item, Work):
            type(item).do([item], item.subject)
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

    def run(
        self, trainings: Sequence[Generator[Told | Work, None, Any]]
    ) -> Iterator[tuple[int, Told]]:
        """What each training tells, with its number, in the order in which it comes."""
        running, waiting = dict(enumerate(trainings)), {}
        while running:
            for number in [n for n in running if n not in waiting]:
                for item in running[number]:
                    if isinstance(item, Work):
                        waiting[number] = item
                        break
                    yield number, item
                else:
                    del running[number]
            self._do_first(waiting)

    def _do_first(self, waiting: dict[int, Work]) -> None:
        """Do the work of lowest rank, equal kinds in one go."""
        rank = min((work.rank for work in waiting.values()), default=0)
        kinds: dict[Hashable, list[Work]] = defaultdict(list)
        for number in [n for n, work in waiting.items() if work.rank == rank]:
            work = waiting.pop(number)
            kinds[type(work), work.kind].append(work)
        for works in kinds.values():
            for some, subject in self._joined(works):
                type(works[0]).do(some, subject)

    def _joined(self, works: Sequence[Work]) -> Iterator[tuple[Sequence[Work], Any]]:
        """The works with their subjects' joint, or one by one where the others are elsewhere."""
        subjects = [work.subject for work in works]
        key = tuple(id(subject) for subject in subjects)
        if key not in self._joints and len(key) > 1 and self._among_others(key):
            for work in works:
                yield from self._joined([work])
            return
        if key not in self._joints:
            joint = type(subjects[0]).joined(subjects) if len(key) > 1 else subjects[0]
            if joint.device.type == "cuda":
                joint.step = graphed(joint.step)
            self._joints[key] = subjects, joint  # the subjects too: an id lives as they do
        yield works, self._joints[key][1]

    def _among_others(self, key: tuple[int, ...]) -> bool:
        """Whether some of them are joined with more: joining them anew would part those."""
        return any(len(known) > 1 and set(known) & set(key) for known in self._joints)
