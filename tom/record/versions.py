"""The versions, commit and machine of a run."""

import os
import platform
import shlex
import subprocess
import sys
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

DECISIVE = {"torch": 3, "gymnasium": 3, "mujoco": 3, "numpy": 2}
"""how many parts of a package's version affect results: numpy's random streams may change with a
feature release, the numbers of others with any release (pyproject.toml pins them)"""

ACCEPT = "--accept-versions"
"""the option that lets a run resume with other versions"""

PACKAGES = ("torch", "numpy", "gymnasium", "mujoco", "tom-studio")


def versions() -> dict[str, str]:
    """The versions that results depend on; `missing` if a package is not installed."""
    found = {"python": platform.python_version()}
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "missing"
    return found


def may_change_results(name: str, before: str, now: str) -> bool:
    """Whether results may change silently between these two versions of the package `name`."""
    parts = DECISIVE.get(name, 0)
    return before.split(".")[:parts] != now.split(".")[:parts]


def git_commit() -> str | None:
    """The commit of this code, with `-dirty` if tracked files differ from it.

    None outside a git checkout or without git.
    """
    commit = _git("rev-parse", "HEAD")
    changed = _git("status", "--porcelain", "--untracked-files=no")
    return f"{commit}-dirty" if commit and changed else commit or None


def command() -> str:
    """This process's command line."""
    return shlex.join(["tom", *sys.argv[1:]])


def made_by(command: str) -> dict[str, Any]:
    """What a result records of the code that made it."""
    return {"command": command, "git_commit": git_commit(), "versions": versions()}


def machine() -> dict[str, Any]:
    """The kind of this machine, without anything that identifies it."""
    cpus = list[str]()
    with suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        cpus = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return {
        "system": platform.system(),
        "arch": platform.machine(),
        "cpu": next(filter(None, cpus), platform.processor()),
        "cores": os.cpu_count(),
    }


def _git(*arguments: str) -> str | None:
    folder = Path(__file__).resolve().parents[2]
    if not (folder / ".git").exists():
        return None
    command = ["git", "-C", str(folder), *arguments]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=5, check=True)
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip()
