"""With which weights a run is shown: its own, or live ones of its buffer (`tom.weigh_live`).

Reads no file but the configurations of live weights.
"""

from tom.learners import SUBJECT
from tom.record.reader import RunReader


def weight_readers(run: RunReader) -> dict[str, RunReader]:
    """The run seen with its own weights, if it has any, and with live ones, by learner."""
    own = {run.learner: run} if has_profiles(run) else {}
    live = run.live().items() if run.own_loop else ()
    return own | dict(sorted(live, key=lambda one: one[0] != SUBJECT))


def first_weight_reader(run: RunReader) -> RunReader:
    """The run seen with the first of its weights."""
    return next(iter(weight_readers(run).values()), run)


def has_profiles(run: RunReader) -> bool:
    """Whether there is a profile, which may be damaged. Reads no file."""
    return any(size for _, size in run.version("profiles"))
