"""The cases of a study, each in a process of its own and kept on disk: a stopped study goes on.

What was computed is found again by the case, the code and the packages that computed it, so an
outcome of other code is never taken for this one's.
"""

import os
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from hashlib import sha256
from multiprocessing import active_children, get_context
from pathlib import Path
from typing import TypeVar, get_type_hints

import torch

from tom.machine.matmul import choose_matmul
from tom.machine.parent import end_with_parent
from tom.record.versions import versions
from tom.studies.outcomes import load, save

Case = TypeVar("Case")
Outcome = TypeVar("Outcome")

FOLDER = "cases"


def each(
    work: Callable[[Case], Outcome], cases: Sequence[Case], jobs: int, out: Path
) -> Iterator[Outcome]:
    """`work(case)` of every case in order, `jobs` at a time, in single-threaded processes.

    `work` is a function of a module that says what it returns, a dataclass of primitives, arrays
    and dataclasses; `repr(case)` says all that decides the outcome. Whatever
    is finished lies in `out/cases` at once, and is taken from there by the next call. Processes
    that still run when the caller stops, or is killed, are ended.
    """
    folder = out / FOLDER
    folder.mkdir(parents=True, exist_ok=True)
    code = code_hash()
    paths = [folder / f"{_name(work, case, code)}.pt" for case in cases]
    kind = get_type_hints(work)["return"]
    found = {path: load(path, kind) for path in paths}
    others = set(active_children())
    pool = ProcessPoolExecutor(jobs, get_context("spawn"), _prepare, (os.getpid(),))
    try:
        ahead = {
            path: pool.submit(_keep, work, case, path)
            for path, case in zip(paths, cases, strict=True)
            if found[path] is None
        }
        for path in paths:
            yield ahead[path].result() if path in ahead else found[path]
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
        for child in set(active_children()) - others:
            child.terminate()


def code_hash() -> str:
    """What decides an outcome beside its case: this package's files, and versions of others."""
    found = sha256(repr(versions()).encode())
    root = Path(__file__).parents[1]
    for path in sorted(root.rglob("*.py")):
        found.update(path.relative_to(root).as_posix().encode() + path.read_bytes())
    return found.hexdigest()


def _name(work: Callable[[Case], Outcome], case: Case, code: str) -> str:
    asked = f"{work.__module__}.{work.__qualname__} {case!r} {code}"
    return sha256(asked.encode()).hexdigest()[:20]


def _keep(work: Callable[[Case], Outcome], case: Case, path: Path) -> Outcome:
    outcome = work(case)
    save(outcome, path)
    return outcome


def _prepare(parent: int) -> None:
    end_with_parent()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the caller's, who ends this process
    if os.getppid() != parent:
        raise SystemExit  # it was killed before it could be told
    torch.set_num_threads(1)
    choose_matmul()
