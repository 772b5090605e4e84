"""`tom doctor`: check whether this machine is ready, and how to fix what is not.

Each check examines one thing and names the fix. Nothing is changed; one file is written into the
store and removed again.
"""

import argparse
import json
import os
import platform
import shutil
import socket
import sys
from importlib import metadata
from pathlib import Path
from tempfile import TemporaryFile
from typing import Literal, NamedTuple

import numpy as np
import torch
from packaging.requirements import Requirement

from tom.cli.parser import add_json, add_store
from tom.cli.tables import show
from tom.envs import ENVS, scene
from tom.errors import UserError, reason
from tom.machine import memory
from tom.machine.matmul import cache_file, choose_matmul
from tom.readable import size
from tom.record import Store
from tom.record.rerun import viewer

PYTHON = (3, 11)
HOST = "127.0.0.1"
LOW_GB, FULL_GB = 10.0, 1.0
STUDIO_BYTES = 500e6  # memory of one of the studio's servers that has read nothing


class Finding(NamedTuple):
    """The result of a check: `bad` needs the fix, `note` is only information."""

    state: Literal["ok", "note", "bad"]
    text: str
    fix: str = ""


def add_parser(subparsers, arguments: list[str]) -> None:
    parser = subparsers.add_parser(
        "doctor",
        description="Check versions, memory, GPU, matrix products, scenes without a display, "
        "ports, disk, browser and store, with the fix beside each finding. Exit code 1 where "
        "something is bad.",
    )
    add_store(parser)
    add_json(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    findings = [{"check": name, **check(name, args.store)._asdict()} for name in CHECKS]
    bad = sum(found["state"] == "bad" for found in findings)
    if args.json:
        print(json.dumps(findings))
    else:
        rows = [list(found.values()) for found in findings]
        show(f"{bad} things to mend" if bad else "ready", ("check", "is", "found", "fix"), rows)
    return 1 if bad else 0


def check(name: str, store: Path) -> Finding:
    """The result of one of the checks; one that raises an error is bad, and the others go on."""
    try:
        return CHECKS[name](store)
    except Exception as error:
        text = f"{type(error).__name__}: {reason(error)}"
        return Finding("bad", text, "see docs/troubleshooting.md")


def _python(_: Path) -> Finding:
    version = platform.python_version()
    if sys.version_info < PYTHON:
        return Finding("bad", version, "make the virtual environment with python3.11")
    return Finding("ok", f"{version} on {platform.system()} {platform.machine()}")


def _packages(_: Path) -> Finding:
    """Compare every requirement of the package with the installed version."""
    wrong = [text for line in metadata.requires("tom-studio") or [] if (text := unmet(line))]
    if wrong:
        return Finding("bad", "; ".join(wrong), "pip install -e . (in the clone)")
    shown = ("tom-studio", "torch", "mujoco", "gymnasium", "numpy")
    return Finding("ok", ", ".join(f"{name} {metadata.version(name)}" for name in shown))


def unmet(line: str) -> str | None:
    """How the installed packages differ from a requirement; None if they do not."""
    needed = Requirement(line)
    if needed.marker and not needed.marker.evaluate({"extra": ""}):
        return None
    try:
        version = metadata.version(needed.name)
    except metadata.PackageNotFoundError:
        return f"{needed.name} is missing"
    if needed.specifier.contains(version, prereleases=True):
        return None
    return f"{needed.name} {version} is not {needed.specifier}"


def _cores(_: Path) -> Finding:
    cores = len(os.sched_getaffinity(0))
    threads = os.environ.get("OMP_NUM_THREADS", "unset")
    return Finding(
        "ok",
        f"{cores} for this process: `tom sweep` trains {cores} runs at a time (OMP_NUM_THREADS "
        f"{threads}; a training sets its own)",
    )


def _memory(_: Path) -> Finding:
    free, cache = memory.available(), memory.STUDIO_CACHE_BYTES
    shown = f"{size(free)} free" if free < sys.maxsize else "nobody knows how much is free"
    text = (
        f"{shown}; each of the studio's two servers keeps at most {size(cache)} of what it "
        "has read, beside the programs themselves"
    )
    if free > 2 * (cache + STUDIO_BYTES):
        return Finding("ok", text)
    return Finding("note", text, "end other programs before `tom studio`")


def _gpu(_: Path) -> Finding:
    fix = "install the CUDA build of the torch version above, and a driver as new as it asks for"
    if torch.cuda.is_available():
        card = torch.cuda.get_device_properties(0)
        try:
            float(torch.ones(8, 8, device="cuda").mm(torch.ones(8, 8, device="cuda")).sum())
        except RuntimeError as error:  # this build of torch does not support the GPU
            return Finding("bad", f"{card.name}: {reason(error)}", fix)
        return Finding("ok", f"{card.name}, {size(card.total_memory)}")
    if Path("/dev/nvidia0").exists():
        return Finding("bad", f"there is one, but torch {torch.__version__} sees none", fix)
    return Finding("note", "none: trainings run on the CPU, one core each")


def _matmul(_: Path) -> Finding:
    report = choose_matmul()
    gain = report.default_ms / report.onednn_ms
    text = f"{report.chosen}: oneDNN is {gain:.2f} times as fast, error {report.onednn_error:.1e}"
    if cache_file().exists():
        text += f" (measured once; delete {cache_file()} to measure anew)"
    return Finding("ok", text)


def _scenes(_: Path) -> Finding:
    """Build every task's geometry as the studio does, without display or OpenGL."""
    for env in ENVS:
        mj = scene.model(env).mj
        geometry = scene.geometry(mj, mj.qpos0[None])
        if not np.isfinite(geometry.capsules.center).all():
            return Finding("bad", f"{env}: its geometry is not finite", "reinstall mujoco")
    return Finding("ok", f"{len(ENVS)} tasks drawn from geometry, no display needed")


def _rerun(_: Path) -> Finding:
    binary, version = viewer.binary(), metadata.version("rerun-sdk")
    if os.access(binary, os.X_OK):
        return Finding("ok", f"viewer {version}")
    fix = f"pip install --force-reinstall rerun-sdk=={version}"
    return Finding("bad", f"{binary} cannot be run", fix)


def _ports(_: Path) -> Finding:
    """Whether the studio can get a port."""
    try:
        socket.create_server((HOST, 0)).close()
    except OSError as error:
        fix = "`ip link set lo up` brings the loopback up, `ulimit -n 4096` allows more open files"
        return Finding("bad", f"none can be opened on {HOST}: {error.strerror}", fix)
    return Finding("ok", f"one could be opened on {HOST}")


def _chromium(_: Path) -> Finding:
    path = shutil.which("chromium") or shutil.which("chromium-browser")
    if path:
        return Finding("ok", path)
    text = "none: `tom studio --screenshots` and the browser tests need it, nothing else does"
    return Finding("note", text, "apt-get install chromium")


def _disk(store: Path) -> Finding:
    folder = next(path for path in (store, *store.resolve().parents) if path.is_dir())
    try:
        with TemporaryFile(dir=folder) as file:
            file.write(b"x")
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        text = f"cannot write into {folder}: {error.strerror}"
        return Finding("bad", text, "name another store with --store")
    free = shutil.disk_usage(folder).free / 1e9
    text = f"{free:.0f} GB free for {store}/"
    if free >= LOW_GB:
        return Finding("ok", text)
    fix = "`tom runs size`, `tom runs prune` and `rm -r STORE/.trash` make room"
    return Finding("bad" if free < FULL_GB else "note", text, fix)


def _store(path: Path) -> Finding:
    """Check each run without reading its arrays."""
    store = Store(path)
    if not path.exists():
        fix = "the first training makes it, or name another with --store"
        return Finding("note", f"{path}/ is not there yet", fix)
    try:
        runs = store.runs()
    except UserError as error:
        return Finding("bad", str(error), "name another store with --store")
    for run in runs:
        _ = run.status, run.labels
    damaged = [run.run_id for run in runs if run.problems] + store.problems
    dead = [run.run_id for run in runs if run.status.shown == "dead"]
    text = f"{len(runs)} runs in {path}/"
    if damaged:
        fix = "`tom runs verify` says what, `tom runs repair RUN` mends it"
        return Finding("bad", f"{text}; with problems: {_some(damaged)}", fix)
    if dead:
        fix = "`tom train --resume RUN` goes on, `tom runs repair RUN` ends it"
        return Finding("note", f"{text}; died without a word: {_some(dead)}", fix)
    return Finding("ok", text)


def _some(names: list[str]) -> str:
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")


CHECKS = {
    "python": _python,
    "packages": _packages,
    "cores": _cores,
    "memory": _memory,
    "gpu": _gpu,
    "matmul": _matmul,
    "scenes": _scenes,
    "rerun": _rerun,
    "ports": _ports,
    "chromium": _chromium,
    "disk": _disk,
    "store": _store,
}
