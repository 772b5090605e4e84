"""`tom doctor`: check whether this machine is ready, and how to fix what is not.

Each check examines one thing and names the fix. Nothing is changed; one file is written into the
store and removed again.
"""

import argparse
import os
import platform
import shutil
from importlib import metadata
from pathlib import Path
from tempfile import TemporaryFile
from typing import Literal, NamedTuple

import torch
from packaging.requirements import Requirement

from tom.cli.output import print_result, show
from tom.cli.parser import add_json, add_store
from tom.errors import reason
from tom.machine import memory
from tom.readable import size
from tom.record import Store

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
        description="Check versions, cores, memory, GPU, browser, disk "
        "and store, with the fix beside each finding. Exit code 1 if something is bad.",
    )
    add_store(parser)
    add_json(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    findings = [{"check": name, **check(name, args.store)._asdict()} for name in CHECKS]
    bad = sum(found["state"] == "bad" for found in findings)
    rows = [list(found.values()) for found in findings]
    title = f"{bad} things to fix" if bad else "ready"
    print_result(args, findings, lambda: show(title, ("check", "is", "found", "fix"), rows))
    return 1 if bad else 0


def check(name: str, store: Path) -> Finding:
    """The result of one of the checks; one that raises an error is bad, and the others go on."""
    try:
        return CHECKS[name](store)
    except Exception as error:
        text = f"{type(error).__name__}: {reason(error)}"
        return Finding("bad", text, "see docs/troubleshooting.md")


def _packages(_: Path) -> Finding:
    """Compare every requirement of the package with what is installed."""
    wrong = [text for line in metadata.requires("tom-studio") or [] if (text := unmet(line))]
    if wrong:
        return Finding("bad", "; ".join(wrong), "pip install -e . (in the clone)")
    shown = ("tom-studio", "torch", "mujoco", "gymnasium", "numpy")
    versions = [f"Python {platform.python_version()}"]
    return Finding("ok", ", ".join(versions + [f"{n} {metadata.version(n)}" for n in shown]))


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


def _machine(_: Path) -> Finding:
    free, cache = memory.available(), memory.STUDIO_CACHE_BYTES
    cores = len(os.sched_getaffinity(0))
    text = (
        f"{cores} cores (`tom sweep` trains one run on each); {size(free)} of memory free (each of "
        f"the studio's two servers takes at most {size(STUDIO_BYTES + cache)})"
    )
    if free > 2 * (cache + STUDIO_BYTES):
        return Finding("ok", text)
    return Finding("note", text, "end other programs before `tom studio`")


def _gpu(_: Path) -> Finding:
    fix = "install the CUDA build of the torch version above, and a driver new enough for it"
    if torch.cuda.is_available():
        card = torch.cuda.get_device_properties(0)
        try:
            float(torch.ones(8, 8, device="cuda").mm(torch.ones(8, 8, device="cuda")).sum())
        except RuntimeError as error:  # this build of torch does not support the GPU
            return Finding("bad", f"{card.name}: {reason(error)}", fix)
        return Finding("ok", f"{card.name}, {size(card.total_memory)}")
    if Path("/dev/nvidia0").exists():
        return Finding("bad", f"present, but torch {torch.__version__} does not see it", fix)
    return Finding("note", "none: trainings run on the CPU, one core each")


def _chromium(_: Path) -> Finding:
    path = shutil.which("chromium") or shutil.which("chromium-browser")
    if path:
        return Finding("ok", path)
    text = "none; only screenshots, films as MP4 and the browser tests need it"
    return Finding("note", text, "apt-get install chromium")


def _disk(store: Path) -> Finding:
    folder = next(path for path in (store, *store.resolve().parents) if path.is_dir())
    try:
        with TemporaryFile(dir=folder) as file:
            file.write(b"x")
    except OSError as error:
        text = f"cannot write into {folder}: {error.strerror}"
        return Finding("bad", text, "name another store with --store")
    free = shutil.disk_usage(folder).free / 1e9
    text = f"{free:.0f} GB free for {store}/"
    if free >= LOW_GB:
        return Finding("ok", text)
    fix = (
        "`tom runs prune` and `rm -r STORE/.trash` free space; `du -sh STORE/*` shows what uses it"
    )
    return Finding("bad" if free < FULL_GB else "note", text, fix)


def _store(path: Path) -> Finding:
    """Check each run without reading its arrays."""
    store = Store(path)
    if not path.exists():
        fix = "the first training creates it, or name another with --store"
        return Finding("note", f"{path}/ does not exist yet", fix)
    runs = store.runs()
    for run in runs:
        _ = run.status, run.labels
    damaged = [run.run_id for run in runs if run.problems] + store.problems
    dead = [run.run_id for run in runs if run.status.shown == "dead"]
    text = f"{len(runs)} runs in {path}/"
    if damaged:
        fix = "`tom runs verify` lists the damage, `tom runs repair RUN` repairs it"
        return Finding("bad", f"{text}; with problems: {', '.join(damaged)}", fix)
    if dead:
        fix = "`tom train --resume RUN` continues it, `tom runs repair RUN` ends it"
        return Finding("note", f"{text}; dead without a reason: {', '.join(dead)}", fix)
    return Finding("ok", text)


CHECKS = {
    "packages": _packages,
    "machine": _machine,
    "gpu": _gpu,
    "chromium": _chromium,
    "disk": _disk,
    "store": _store,
}
