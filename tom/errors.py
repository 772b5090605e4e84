"""Errors in one line: those a user can fix, those that end a training, and any other."""

from collections.abc import Iterable
from difflib import get_close_matches

OF_USERS = (Exception, SystemExit)
"""What code of the user's may raise: a script that is imported may end the program."""


START_AGAIN = "start it again"
"""the advice for a run that can never go on; a sweep follows it"""

NOT_NOW = "cannot be read for now"
"""of a run that may well go on later; a sweep tries again"""


class UserError(Exception):
    """Bad input. The command line prints its one line and exits with code 2."""


class OwnCodeError(UserError):
    """Code of the user's failed while it ran: a task, a learner, a rule of termination."""


def unknown(kind: str, name: str, known: Iterable[str]) -> UserError:
    """The error for a name that is not one of `known`; suggests the nearest.

    >>> str(unknown("learner", "pmacs", ["mle", "pmac", "tom"]))
    "unknown learner 'pmacs': did you mean 'pmac'? Known: mle, pmac, tom"
    """
    names = list(known)
    near = get_close_matches(name.lower(), names, n=1, cutoff=0.5)
    hint = f"did you mean '{near[0]}'? " if near else ""
    return UserError(f"unknown {kind} '{name}': {hint}Known: {', '.join(names)}")


def reason(error: BaseException) -> str:
    """Why something failed: the first line of an error, or its type if it has no message."""
    lines = str(error).strip().splitlines() or [type(error).__name__]
    return lines[0][:200]


class DivergedError(Exception):
    """The training cannot go on; the message has the cause, the step and what to try."""
