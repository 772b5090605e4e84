"""The checks of `tom doctor`; each looks at one thing and names the fix.

Nothing is changed; one file is written into the store and removed again.
"""

import os
import platform
import shutil
import socket
import sys
from collections.abc import Callable, Iterable
from contextlib import ExitStack
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from tempfile import TemporaryFile
from typing import Literal

import numpy as np
import torch
from packaging.requirements import Requirement

from tom.envs import ENVS, scene
from tom.errors import UserError, reason
from tom.machine import memory
from tom.machine.matmul import cache_file, choose_matmul
from tom.readable import size
from tom.record import Store
from tom.record.rerun import hub

State = Literal["ok", "note", "bad"]

PYTHON = (3, 11)
HOST, SERVERS = "127.0.0.1", 3  # the studio's address and number of ports
LOW_GB, FULL_GB = 10.0, 1.0
STUDIO_BYTES = 500e6  # memory of one of the studio's servers that has read nothing


@dataclass(frozen=True)
class CheckResult:
    """The result of a check: `bad` needs the fix, `note` is only information."""

    check: str
    state: State
    text: str
    fix: str = ""


def examine(store: Path) -> list[CheckResult]:
    """Run every check in order; a check that raises an error gives a bad result."""
    checks: list[tuple[str, Callable[[], CheckResult]]] = [
        ("python", _python),
        ("packages", _packages),
        ("cores", _cores),
        ("memory", _memory),
        ("gpu", _gpu),
        ("matmul", _matmul),
        ("scenes", _scenes),
        ("rerun", _rerun),
        ("ports", _ports),
        ("chromium", _chromium),
        ("disk", lambda: _disk(store)),
        ("store", lambda: _store(store)),
    ]
    return [_guarded(name, check) for name, check in checks]


def _guarded(name: str, check: Callable[[], CheckResult]) -> CheckResult:
    try:
        return check()
    except Exception as error:  # the other checks go on
        text = f"{type(error).__name__}: {reason(error)}"
        return CheckResult(name, "bad", text, "see docs/troubleshooting.md")


def _python() -> CheckResult:
    version = platform.python_version()
    if tuple(map(int, version.split(".")[:2])) < PYTHON:
        return CheckResult("python", "bad", version, "make the virtual environment with python3.11")
    return CheckResult("python", "ok", f"{version} on {platform.system()} {platform.machine()}")


def _packages() -> CheckResult:
    """Compare every requirement of the package with the installed version."""
    wrong = [text for line in metadata.requires("tom-studio") or [] if (text := _unmet(line))]
    if wrong:
        return CheckResult("packages", "bad", "; ".join(wrong), "pip install -e . (in the clone)")
    named = ("tom-studio", "torch", "mujoco", "gymnasium", "numpy")
    return CheckResult("packages", "ok", ", ".join(f"{n} {metadata.version(n)}" for n in named))


def _unmet(line: str) -> str | None:
    needed = Requirement(line)
    if needed.marker and not needed.marker.evaluate({"extra": ""}):
        return None
    try:
        held = metadata.version(needed.name)
    except metadata.PackageNotFoundError:
        return f"{needed.name} is missing"
    if needed.specifier.contains(held, prereleases=True):
        return None
    return f"{needed.name} {held} is not {needed.specifier}"


def _cores() -> CheckResult:
    cores = len(os.sched_getaffinity(0))
    threads = os.environ.get("OMP_NUM_THREADS", "unset")
    text = f"{cores} for this process: `tom sweep` trains {cores} runs at a time"
    return CheckResult(
        "cores", "ok", f"{text} (OMP_NUM_THREADS {threads}; a training sets its own)"
    )


def _memory() -> CheckResult:
    free = memory.available()
    bound = memory.STUDIO_CACHE_BYTES
    words = f"{size(free)} free" if free < sys.maxsize else "nobody knows how much is free"
    text = (
        f"{words}; each of the studio's two servers keeps at most {size(bound)} of what it "
        "has read, beside the programs themselves"
    )
    if free > 2 * (bound + STUDIO_BYTES):
        return CheckResult("memory", "ok", text)
    return CheckResult("memory", "note", text, "end other programs before `tom studio`")


def _gpu() -> CheckResult:
    fix = "install the CUDA build of the torch version above, and a driver as new as it asks for"
    if torch.cuda.is_available():
        card = torch.cuda.get_device_properties(0)
        try:
            float(torch.ones(8, 8, device="cuda").mm(torch.ones(8, 8, device="cuda")).sum())
        except RuntimeError as error:  # this build of torch does not support the GPU
            return CheckResult("gpu", "bad", f"{card.name}: {reason(error)}", fix)
        return CheckResult("gpu", "ok", f"{card.name}, {size(card.total_memory)}")
    if Path("/dev/nvidia0").exists():
        return CheckResult(
            "gpu", "bad", f"there is one, but torch {torch.__version__} sees none", fix
        )
    return CheckResult("gpu", "note", "none: trainings run on the CPU, one core each")


def _matmul() -> CheckResult:
    report = choose_matmul()
    gain = report.default_ms / report.onednn_ms
    text = f"{report.chosen}: oneDNN is {gain:.2f} times as fast, error {report.onednn_error:.1e}"
    if cache_file().exists():
        text += f" (measured once; delete {cache_file()} to measure anew)"
    return CheckResult("matmul", "ok", text)


def _scenes() -> CheckResult:
    """Build every task's geometry as the studio does, without display or OpenGL."""
    for env in ENVS:
        mj = scene.model(env).mj
        made = scene.geometry(mj, mj.qpos0[None])
        if not np.isfinite(made.capsules.center).all():
            return CheckResult(
                "scenes", "bad", f"{env}: its geometry is not finite", "reinstall mujoco"
            )
    return CheckResult("scenes", "ok", f"{len(ENVS)} tasks drawn from geometry, no display needed")


def _rerun() -> CheckResult:
    binary = hub.binary()
    if not os.access(binary, os.X_OK):
        fix = f"pip install --force-reinstall rerun-sdk=={metadata.version('rerun-sdk')}"
        return CheckResult("rerun", "bad", f"{binary} cannot be run", fix)
    return CheckResult("rerun", "ok", f"viewer {metadata.version('rerun-sdk')}")


def _ports() -> CheckResult:
    """Whether every server of the studio can get a port."""
    try:
        with ExitStack() as opened:
            for _ in range(SERVERS):
                opened.enter_context(socket.create_server((HOST, 0)))
    except OSError as error:
        fix = "`ip link set lo up` brings the loopback up, `ulimit -n 4096` allows more open files"
        return CheckResult("ports", "bad", f"none can be opened on {HOST}: {error.strerror}", fix)
    return CheckResult("ports", "ok", f"{SERVERS} could be opened on {HOST}")


def _chromium() -> CheckResult:
    path = shutil.which("chromium") or shutil.which("chromium-browser")
    if path:
        return CheckResult("chromium", "ok", path)
    text = "none: `tom studio --screenshots` and the browser tests need it, nothing else does"
    return CheckResult("chromium", "note", text, "apt-get install chromium")


def _disk(store: Path) -> CheckResult:
    folder = next(path for path in (store, *store.resolve().parents) if path.is_dir())
    try:
        with TemporaryFile(dir=folder) as file:
            file.write(b"x")
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        return CheckResult("disk", "bad", f"cannot write into {folder}: {error.strerror}",
                       "name another store with --store")  # fmt: skip
    free = shutil.disk_usage(folder).free / 1e9
    text = f"{free:.0f} GB free for {store}/"
    fix = "`tom runs size`, `tom runs prune` and `rm -r STORE/.trash` make room"
    if free < FULL_GB:
        return CheckResult("disk", "bad", text, fix)
    return CheckResult(
        "disk", "note" if free < LOW_GB else "ok", text, fix if free < LOW_GB else ""
    )


def _store(path: Path) -> CheckResult:
    """Check each run without reading its arrays."""
    store = Store(path)
    if not path.exists():
        fix = "the first training makes it, or name another with --store"
        return CheckResult("store", "note", f"{path}/ is not there yet", fix)
    try:
        runs = store.runs()
    except UserError as error:
        return CheckResult("store", "bad", str(error), "name another store with --store")
    for run in runs:
        _ = run.status, run.labels
    damaged = [run.run_id for run in runs if run.problems]
    dead = [run.run_id for run in runs if run.status.shown == "dead"]
    text = f"{len(runs)} runs in {path}/"
    if damaged or store.problems:
        about = [*damaged, *store.problems]
        fix = "`tom runs verify` says what, `tom runs repair RUN` mends it"
        return CheckResult("store", "bad", f"{text}; with problems: {_some(about)}", fix)
    if dead:
        fix = "`tom train --resume RUN` goes on, `tom runs repair RUN` ends it"
        return CheckResult("store", "note", f"{text}; died without a word: {_some(dead)}", fix)
    return CheckResult("store", "ok", text)


def _some(names: Iterable[str]) -> str:
    listed = list(names)
    return ", ".join(listed[:3]) + (f" and {len(listed) - 3} more" if len(listed) > 3 else "")
