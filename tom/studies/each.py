"""Run the cases of a study, each in its own process; outcomes are stored, so a study can resume.

An outcome is stored under a key of the case, the code and the package versions, so that an outcome
of other code is never used. The processes load the plug-ins and modules that the user named, and
their files count as code.
"""

import _codecs
import os
import pickle
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import suppress
from dataclasses import fields, is_dataclass
from hashlib import sha256
from multiprocessing import active_children, get_context
from pathlib import Path
from typing import Any, TypeVar, get_args, get_type_hints

import numpy as np
import torch
from numpy.dtypes import Float32DType, Float64DType, Int64DType

from tom import plugins
from tom.data.unpack import DAMAGE
from tom.envs import bring, brought
from tom.envs.termination import bring_rule, brought_rules
from tom.envs.user_code import users_code
from tom.errors import UserError
from tom.machine.matmul import choose_matmul
from tom.machine.processes import end_with_parent
from tom.record.files import replace
from tom.record.versions import versions

Case = TypeVar("Case")
Outcome = TypeVar("Outcome")

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


def each(
    work: Callable[[Case], Outcome], cases: Sequence[Case], jobs: int, out: Path
) -> Iterator[Outcome]:
    """`work(case)` of every case in order, `jobs` at a time, in single-threaded processes.

    `work` is a module's function with an annotated return type, made of primitives, dicts,
    arrays and dataclasses; `repr(case)` must determine the outcome. Finished outcomes are stored in
    `out/cases` at once, and the next call reads them. Running processes end when the caller stops
    or is killed.
    """
    folder = out / FOLDER
    folder.mkdir(parents=True, exist_ok=True)
    code = code_hash()
    paths = [folder / f"{_name(work, case, code)}.pt" for case in cases]
    kind = get_type_hints(work)["return"]
    stored = {path: load(path, kind) for path in paths}
    others = set(active_children())
    named = (os.getpid(), brought(), brought_rules())
    pool = ProcessPoolExecutor(jobs, get_context("spawn"), _prepare, named)
    try:
        ahead = {
            path: pool.submit(_keep, work, case, path)
            for path, case in zip(paths, cases, strict=True)
            if stored[path] is None
        }
        for path in paths:
            yield ahead[path].result() if path in ahead else stored[path]
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
        for child in set(active_children()) - others:
            child.terminate()


def code_hash() -> str:
    """A hash of what affects an outcome besides its case: this package's files and versions, and
    the files or packages that the user named (not what these import in turn)."""
    digest = sha256(repr(versions()).encode())
    for root in (Path(__file__).parents[1], *users_code()):
        for path in sorted(root.rglob("*.py")) if root.is_dir() else [root]:
            digest.update(path.relative_to(root.parent).as_posix().encode() + path.read_bytes())
    return digest.hexdigest()


def _name(work: Callable[[Case], Outcome], case: Case, code: str) -> str:
    asked = f"{work.__module__}.{work.__qualname__} {case!r} {code}"
    return sha256(asked.encode()).hexdigest()[:20]


def _keep(work: Callable[[Case], Outcome], case: Case, path: Path) -> Outcome:
    outcome = work(case)
    save(outcome, path)
    return outcome


def _prepare(parent: int, tasks: Sequence[str], rules: Sequence[str]) -> None:
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
            bring(name)
    for name in rules:
        with suppress(UserError):
            bring_rule(name)


def save(outcome: object, path: Path) -> None:
    """Write an outcome atomically: primitives, dicts, arrays and dataclasses of them."""
    replace(path, lambda file: torch.save(outcome, file), sync=True)


def load(path: Path, kind: type) -> Any:
    """The outcome of type `kind` at `path`, read without executing code from the file; None if it
    cannot be read."""
    try:
        with torch.serialization.safe_globals([*ARRAYS, *classes(kind)]):
            return torch.load(path, weights_only=True)
    except (*DAMAGE, pickle.UnpicklingError):
        return None


def classes(kind: Any) -> Iterator[type]:
    """The dataclass `kind` and those among its fields, at any depth."""
    for part in get_args(kind):
        yield from classes(part)
    if isinstance(kind, type) and is_dataclass(kind):
        yield kind
        hints = get_type_hints(kind)
        for field in fields(kind):
            yield from classes(hints[field.name])
