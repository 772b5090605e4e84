"""What a study is: a claim of the paper, what is computed for it, and what was found.

`tom reproduce` (tom/cli/reproduce.py) does the rest: progress, files, report, JSON, exit code.
"""

import os
import sys
from argparse import ArgumentParser, ArgumentTypeError, Namespace
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from matplotlib.figure import Figure

from tom.config import SacRecordingConfig
from tom.envs import task
from tom.errors import UserError, unknown
from tom.record import RunReader, Store
from tom.studies.each import each

Case = TypeVar("Case")
Outcome = TypeVar("Outcome")
Row = dict[str, Any]
"""a line of a table or of a CSV file, by the titles of its columns"""


@dataclass(frozen=True)
class Lab:
    """Where a study computes, with a line of progress for each finished case."""

    out: Path
    jobs: int
    record: Callable[[Store, SacRecordingConfig], RunReader]
    """makes a recording of SAC, or goes on with one that was stopped"""

    def compute(
        self,
        work: Callable[[Case], Outcome],
        cases: Sequence[Case],
        told: Callable[[Outcome], str],
    ) -> list[Outcome]:
        """`work` of every case (`tom.studies.each`); `told` names a finished one to the user."""
        make_folder(self.out)
        done: list[Outcome] = []
        for one in each(work, cases, self.jobs, self.out):
            done.append(one)
            say(f"{len(done)} of {len(cases)}: {told(one)}")
        return done


@dataclass(frozen=True)
class Table:
    """A table of the report and of the screen, which may have `brief` rows of its own."""

    title: str
    rows: Sequence[Mapping[str, Any]]
    brief: Sequence[Mapping[str, Any]] | None = None


@dataclass(frozen=True)
class Findings:
    """What a study found."""

    said: Sequence[str]
    """in sentences: whether the paper's claim holds"""
    files: Mapping[str, Iterable[Mapping[str, Any]]]
    """the rows of each CSV file, by its name"""
    figures: Mapping[str, tuple[str, Callable[[], Figure]]]
    """caption and drawing of each picture, by the file's name"""
    tables: Sequence[Table]
    checks: Sequence[Mapping[str, Any]] = ()
    """our acceptance: rows with `name` and `met`, which is None where nothing is judged"""
    origin: Mapping[str, str] = field(default_factory=dict)
    json: Mapping[str, Any] = field(default_factory=dict)
    """what `--json` prints beside the sentences"""


@dataclass(frozen=True)
class Study:
    """A study: one command of `tom reproduce`."""

    name: str
    title: str
    doc: str | None
    """what is computed, the question in the first line: the docstring of its module"""
    claim: str
    """what the paper says"""
    options: Callable[[ArgumentParser], None]
    find: Callable[[Namespace, Lab], Findings]
    """computes; raises UserError for bad input before anything is written"""


def at_least(name: str, value: float, bound: float) -> Row:
    """A number of the acceptance, met if it is at least `bound`; never for NaN."""
    return {
        "name": name,
        "value": float(value),
        "bound": f">= {bound:g}",
        "met": bool(value >= bound),
    }


def at_most(name: str, value: float, bound: float) -> Row:
    """A number of the acceptance, met if it is at most `bound`; never for NaN."""
    return {
        "name": name,
        "value": float(value),
        "bound": f"<= {bound:g}",
        "met": bool(value <= bound),
    }


def whole(least: int) -> Callable[[str], int]:
    """The type of an option: a whole number of at least `least`."""

    def kind(word: str) -> int:
        if (number := int(word)) < least:
            raise ArgumentTypeError(f"must be at least {least}")
        return number

    return kind


def add_env(parser: ArgumentParser, names: Sequence[str], help: str | None = None) -> None:
    """Add `--env`, the tasks of a study."""
    parser.add_argument("--env", nargs="+", default=list(names), metavar="ENV", help=help)


def add_store(parser: ArgumentParser) -> None:
    """Add `--store`, where a study finds its runs."""
    parser.add_argument("--store", type="folder", default=Path("runs"), help="run store (runs/)")


def add_jobs(parser: ArgumentParser) -> None:
    """Add `--jobs`, how many cases are computed at a time."""
    cores = len(os.sched_getaffinity(0))
    parser.add_argument("--jobs", type=whole(1), default=cores, help="cases at a time [one a core]")


def tasks(names: Iterable[str]) -> list[str]:
    """The names of the tasks, each once. Raises UserError for an unknown one."""
    return list(dict.fromkeys(task(name).name for name in names))


def check_known(kind: str, names: Iterable[str], known: Iterable[str]) -> None:
    """Raises UserError for a name that is none of `known`."""
    for name in names:
        if name not in known:
            raise unknown(kind, name, known)


def as_the_paper_says(held: int, of: int) -> str:
    """The end of a sentence that counts where a claim of the paper held."""
    if held == of:
        return "as the paper says."
    return "mostly as the paper says." if 2 * held > of else "the paper says otherwise."


def make_folder(path: Path) -> None:
    """Make the folder of a report. Raises UserError if it cannot be made."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"cannot make {path}: {error.strerror}; name another --out") from error


def say(line: str) -> None:
    """Print a line of progress to stderr, so that stdout stays readable for a script."""
    print(line, file=sys.stderr, flush=True)
