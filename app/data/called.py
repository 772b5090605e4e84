"""What runs are called where several are shown together."""

from collections import Counter
from collections.abc import Sequence
from typing import Protocol

from app.theme import learner_label


class Named(Protocol):
    """Something that knows whose run it is: a `RunInfo`, a `RunReader`."""

    @property
    def run_id(self) -> str: ...
    @property
    def learner(self) -> str: ...
    @property
    def seed(self) -> int: ...


def told_apart(runs: Sequence[Named]) -> dict[str, str]:
    """`TOM s0` for each run id, and the id after it for those that would be called the same."""
    short = {run.run_id: f"{learner_label(run.learner)} s{run.seed}" for run in runs}
    count = Counter(short.values())
    return {
        run_id: words if count[words] == 1 else f"{words}, {run_id}"
        for run_id, words in short.items()
    }
