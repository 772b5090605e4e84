"""What studies share: their options, cases and findings.

A study is a module: its docstring says what is computed, `TITLE` and `CLAIM` (what the paper says)
head its report, `add_options(parser)` adds its options, and `find(args)` computes its `Findings`,
or raises UserError for bad input before anything is written. `verdict(tables)` answers its
`QUESTION` from the rows of its files (tom/studies/verdicts.py). `tom reproduce`
(tom/cli/reproduce.py) does the rest: files, report, JSON, exit code.

A study's cases run each in its own process, and their outcomes are stored, so a study can resume.
An outcome is stored under a key of the case, the code and the package versions, so that an outcome
of other code is never used. The processes load the plug-ins and modules that the user named, and
their files count as code.
"""

import _codecs
import os
import pickle
import signal
import sys
from argparse import ArgumentParser, Namespace
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field, fields, is_dataclass
from hashlib import sha256
from multiprocessing import active_children, get_context
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, get_args, get_type_hints

import numpy as np
import torch
from numpy.dtypes import Float32DType, Float64DType, Int64DType

from tom import plugins
from tom.data.unpack import DAMAGE
from tom.envs import import_task, imported_tasks, task
from tom.envs.termination import import_rule, imported_rules
from tom.envs.user_code import user_code_paths
from tom.errors import UserError, check_known
from tom.learners import LEARNERS
from tom.machine.matmul import choose_matmul
from tom.machine.processes import end_with_parent
from tom.readable import whole
from tom.record.files import replace
from tom.record.versions import versions
from tom.training.presets import PRESETS

if TYPE_CHECKING:  # the studio counts cases without loading matplotlib
    from matplotlib.figure import Figure

Case = TypeVar("Case")
Outcome = TypeVar("Outcome")
Row = dict[str, Any]
"""a line of a table or of a CSV file, by the titles of its columns"""


@dataclass(frozen=True)
class Findings:
    """What a study found."""

    sentences: Sequence[str]
    """what the tables say, in sentences; whether the claim holds is the verdict's to say"""
    files: Mapping[str, Iterable[Mapping[str, Any]]]
    """the rows of each CSV file, by its name"""
    titles: Mapping[str, str]
    """of those files that are tables of the report, the screen and the JSON as well"""
    figures: Mapping[str, tuple[str, "Figure"]]
    """caption and picture, by the file's name"""
    checks: Sequence[Mapping[str, Any]] = ()
    """our acceptance: rows with `name` and `met`, which is None where nothing is judged"""
    origin: Mapping[str, str] = field(default_factory=dict)


def check(name: str, value: float, sign: str, bound: float) -> Row:
    """A number of the acceptance; NaN meets no bound."""
    met = {">=": value >= bound, "<=": value <= bound, "<": value < bound}[sign]
    return {"name": name, "value": float(value), "bound": f"{sign} {bound:g}", "met": bool(met)}


def add_runs(parser: ArgumentParser, envs: Iterable[str], help: str | None = None) -> None:
    """Add `--env`, the tasks of a study, and `--store`, where it finds their runs."""
    parser.add_argument("--env", nargs="+", default=list(envs), metavar="ENV", help=help)
    parser.add_argument("--store", type="folder", default=Path("runs"), help="run store [runs/]")


def add_groups(parser: ArgumentParser) -> None:
    """Add `--preset` and `--learner`, the trainings that a study of whole runs looks at."""
    parser.add_argument(
        "--preset", nargs="+", metavar="PRESET", default=["paper", "mended"],
        help="[paper mended]: runs of the first are named by their learner only, others by both",
    )  # fmt: skip
    parser.add_argument(
        "--learner", nargs="+", default=list(LEARNERS), metavar="LEARNER",
        help="ours, or a plug-in's [all]",
    )  # fmt: skip


def check_groups(args: Namespace) -> None:
    """Raises UserError for an unknown preset or learner."""
    check_known("preset", args.preset, PRESETS)
    check_known("learner", args.learner, LEARNERS)


def add_jobs(parser: ArgumentParser) -> None:
    """Add `--jobs`, how many cases are computed at a time."""
    cores = len(os.sched_getaffinity(0))
    parser.add_argument(
        "--jobs", type=whole(1), default=cores, help="cases at a time [one per core]"
    )


def tasks(names: Iterable[str]) -> list[str]:
    """The names of the tasks, each once. Raises UserError for an unknown one."""
    return list(dict.fromkeys(task(name).name for name in names))


def make_folder(path: Path) -> None:
    """Make the folder of a report. Raises UserError if it cannot be made."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"cannot make {path}: {error.strerror}; name another --out") from error


def say(line: str) -> None:
    """Print a line of progress to stderr, so that stdout stays readable for a script."""
    print(line, file=sys.stderr, flush=True)


# The cases of a study.

FOLDER = "cases"

# Types needed to load arrays; all others are primitives or the outcome's own classes.
ARRAYS: tuple[Any, ...] = (
    np.ndarray,
    np.dtype,
    np.ndarray.__reduce__(np.zeros(0))[0],
    np.float64.__reduce__(np.float64())[0],
    Float32DType,
    Float64DType,
    Int64DType,
    _codecs.encode,
)


def compute(
    args: Namespace,
    work: Callable[[Case], Outcome],
    cases: Sequence[Case],
    label: Callable[[Outcome], str],
) -> list[Outcome]:
    """`work(case)` of every case in order, `args.jobs` at a time, in single-threaded processes.

    `work` is a module's function with an annotated return type, made of primitives, dicts,
    arrays and dataclasses; `repr(case)` must determine the outcome. Finished outcomes are stored in
    `args.out/cases` at once, and the next call reads them; `label` names one to the user. Running
    processes end when the caller stops or is killed.
    """
    make_folder(folder := args.out / FOLDER)
    code = code_hash()
    keys = (f"{work.__module__}.{work.__qualname__} {case!r} {code}" for case in cases)
    paths = [folder / f"{sha256(one.encode()).hexdigest()[:20]}.pt" for one in keys]
    kind = get_type_hints(work)["return"]
    stored = {path: load_outcome(path, kind) for path in paths}
    others, done = set(active_children()), list[Outcome]()
    named = (os.getpid(), imported_tasks(), imported_rules())
    pool = ProcessPoolExecutor(args.jobs, get_context("spawn"), _initialise_worker, named)
    try:
        ahead = {
            path: pool.submit(_compute_and_save, work, case, path)
            for path, case in zip(paths, cases, strict=True)
            if stored[path] is None
        }
        for path in paths:
            done.append(ahead[path].result() if path in ahead else stored[path])
            say(f"{len(done)} of {len(cases)}: {label(done[-1])}")
        return done
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
        for child in set(active_children()) - others:
            child.terminate()


def code_hash() -> str:
    """A hash of what affects an outcome besides its case: this package's files and versions, and
    the files or packages that the user named (not what these import in turn)."""
    digest = sha256(repr(versions()).encode())
    for root in (Path(__file__).parents[1], *user_code_paths()):
        for path in sorted(root.rglob("*.py")) if root.is_dir() else [root]:
            digest.update(path.relative_to(root.parent).as_posix().encode() + path.read_bytes())
    return digest.hexdigest()


def _compute_and_save(work: Callable[[Case], Outcome], case: Case, path: Path) -> Outcome:
    outcome = work(case)
    save_outcome(outcome, path)
    return outcome


def _initialise_worker(parent: int, tasks: Sequence[str], rules: Sequence[str]) -> None:
    end_with_parent()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the caller handles Ctrl-C and ends this process
    if os.getppid() != parent:
        raise SystemExit  # the caller was killed before
    torch.set_num_threads(1)
    choose_matmul()
    with suppress(UserError):  # the case that needs what cannot be had says so
        plugins.load()
    for name in tasks:
        with suppress(UserError):
            import_task(name)
    for name in rules:
        with suppress(UserError):
            import_rule(name)


def save_outcome(outcome: object, path: Path) -> None:
    """Write an outcome atomically: primitives, dicts, arrays and dataclasses of them."""
    replace(path, lambda file: torch.save(outcome, file), sync=True)


def load_outcome(path: Path, kind: type) -> Any:
    """The outcome of type `kind` at `path`, read without executing code from the file; None if it
    cannot be read."""
    try:
        with torch.serialization.safe_globals([*ARRAYS, *dataclasses_of(kind)]):
            return torch.load(path, weights_only=True)
    except (*DAMAGE, pickle.UnpicklingError):
        return None


def dataclasses_of(kind: Any) -> Iterator[type]:
    """The dataclass `kind` and those among its fields, at any depth."""
    for part in get_args(kind):
        yield from dataclasses_of(part)
    if isinstance(kind, type) and is_dataclass(kind):
        yield kind
        hints = get_type_hints(kind)
        for field in fields(kind):
            yield from dataclasses_of(hints[field.name])
