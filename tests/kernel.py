"""What the kernel says of processes, and how to wait for it."""

import time
from collections.abc import Callable
from pathlib import Path

LOOPBACK = {"0100007F", "0" * 24 + "01000000"}
"""127.0.0.1 in IPv4 and in IPv6, as the kernel writes it"""


def wait_for(holds: Callable[[], object], seconds: float = 60) -> None:
    """Wait until something holds that another process or thread does."""
    deadline = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < deadline
        time.sleep(0.005)


def descendants(pid: int) -> set[int]:
    """The processes under `pid`, by what the kernel says."""
    parents: dict[int, int] = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                fields = (entry / "stat").read_text().rpartition(")")[2].split()
            except OSError:
                continue
            parents[int(entry.name)] = int(fields[1])
    found = {pid}
    while more := {child for child, parent in parents.items() if parent in found} - found:
        found |= more
    return found - {pid}


def alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def listening(processes: set[int]) -> set[tuple[str, int]]:
    """(address, port) on which a process listens; addresses as the kernel writes them."""
    inodes = set()
    for pid in processes:
        for link in Path(f"/proc/{pid}/fd").glob("*"):
            try:
                target = str(link.readlink())
            except OSError:
                continue
            inodes |= {target[8:-1]} if target.startswith("socket:[") else set()
    found = set()
    for table in ("tcp", "tcp6"):
        for line in Path(f"/proc/net/{table}").read_text().splitlines()[1:]:
            fields = line.split()
            if fields[3] == "0A" and fields[9] in inodes:
                address, _, port = fields[1].partition(":")
                found.add((address, int(port, 16)))
    return found
