"""A store to break, and a disk of two megabytes."""

import os
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from tom.record import Store


@pytest.fixture
def store(made: Path, tmp_path: Path) -> Store:
    """A copy of the store that the module has `made` once."""
    return Store(shutil.copytree(made, tmp_path / "store"))


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A real file system of 2 MB.

    A tmpfs where this process may mount one; else that of a process which may inside a user
    namespace of its own, reached through /proc.
    """
    if os.geteuid() == 0 and _mount(tmp_path):
        yield tmp_path
        subprocess.run(["umount", "-l", str(tmp_path)], check=True)
        return
    inside = "mount -t tmpfs -o size=2m tmpfs /mnt && echo ready && exec sleep 600"
    command = ["unshare", "--user", "--map-root-user", "--mount", "sh", "-c", inside]
    holder = subprocess.Popen(command, stdout=subprocess.PIPE)
    assert holder.stdout is not None
    assert holder.stdout.readline() == b"ready\n", "neither mount nor user namespaces here"
    yield Path(f"/proc/{holder.pid}/root/mnt")
    holder.kill()
    holder.wait()


def _mount(path: Path) -> bool:
    if shutil.which("mount") is None:
        return False
    command = ["mount", "-t", "tmpfs", "-o", "size=2m", "tmpfs", str(path)]
    return subprocess.run(command, capture_output=True, check=False).returncode == 0
