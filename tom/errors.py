"""Errors in one line: those a user can fix, those that end a training, and any other."""

import errno
import os
from collections.abc import Collection, Iterable
from difflib import get_close_matches
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pydantic import ValidationError

USER_CODE_ERRORS = (Exception, SystemExit)
"""What code of the user's may raise: a script that is imported may end the program."""

DISK_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)

FAILED, BAD_INPUT, TRY_LATER = 1, 2, os.EX_TEMPFAIL
"""exit codes of a command that did not do what it was asked to"""


class UserError(Exception):
    """Bad input. The command line prints its one line and exits with `exit_code`."""

    exit_code = BAD_INPUT


class OwnCodeError(UserError):
    """Code of the user's failed while it ran: a task, a learner, a rule of termination."""


class TryLaterError(UserError):
    """Something is in the way for now: the same command may succeed later."""

    exit_code = TRY_LATER


class StartAgainError(UserError):
    """A run can never go on; `--resume auto` of its own command begins it anew."""


def unknown(kind: str, name: str, known: Iterable[str]) -> UserError:
    """The error for a name that is not one of `known`; suggests the nearest.

    >>> str(unknown("learner", "pmacs", ["mle", "pmac", "tom"]))
    "unknown learner 'pmacs': did you mean 'pmac'? Known: mle, pmac, tom"
    """
    names = list(known)
    near = get_close_matches(name.lower(), names, n=1, cutoff=0.5)
    hint = f"did you mean '{near[0]}'? " if near else ""
    return UserError(f"unknown {kind} '{name}': {hint}Known: {', '.join(names)}")


def check_known(kind: str, names: Iterable[str], known: Collection[str]) -> None:
    """Raises the error of `unknown` for the first name that is none of `known`."""
    for name in names:
        if name not in known:
            raise unknown(kind, name, known)


def reason(error: BaseException) -> str:
    """Why something failed: the first line of an error, or its type if it has no message."""
    lines = str(error).strip().splitlines() or [type(error).__name__]
    return lines[0][:200]


def invalid_value(error: "ValidationError") -> str:
    """Pydantic's first error in one line: `sac.lr -1: must be greater than 0`."""
    first = error.errors(include_url=False)[0]
    path, value = ".".join(map(str, first["loc"])), first["input"]
    shown = "" if isinstance(value, dict | list | tuple) else f" {value}"
    return f"{path}{shown}: {first['msg'].replace('Input should be', 'must be')}"


class DivergedError(Exception):
    """The training cannot go on; the message has the cause, the step and what to try."""


class GoneError(Exception):
    """The cluster is gone: no training can be started, and the running ones cannot be reached."""
