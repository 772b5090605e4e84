"""Memory: what is free, and the C library's, which a training asks for again at once."""

import ctypes
import sys
from pathlib import Path

import torch

from tom.errors import reason

# glibc's `mallopt` and its parameters (malloc.h).
_TRIM_THRESHOLD, _TOP_PAD, _MMAP_THRESHOLD = -1, -2, -3
MEBIBYTE = 2**20


def available() -> int:
    """Bytes of memory that this machine has free; where nobody knows, more than any has."""
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
    except OSError:
        return sys.maxsize
    free = [line.split()[1] for line in lines if line.startswith("MemAvailable:")]
    return int(free[0]) * 1024 if free else sys.maxsize


_REFUSALS = ("can't allocate memory", "not allocate memory", "can't start new thread")
"""what torch, MuJoCo and the kernel say when there is no more memory"""


def ran_out(error: BaseException) -> bool:
    """The error says that there was not enough memory for what was asked."""
    known = isinstance(error, MemoryError | torch.OutOfMemoryError)
    return known or any(words in str(error) for words in _REFUSALS)


def out_of_memory(error: BaseException) -> str:
    """Such an error in words, with what to do about it."""
    return (
        f"not enough memory ({reason(error)}): take smaller networks, batches or buffers, or free "
        "some"
    )


def keep_freed_memory() -> bool:
    """Keep freed memory in this process instead of handing it back; whether that could be done.

    By default glibc returns blocks of some hundred kilobytes to the system and fetches them again
    page by page, which made whole network evaluations a third slower, or not, by their sizes.
    """
    if sys.platform != "linux":
        return False
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is None:  # another C library
        return False
    settings = {
        _MMAP_THRESHOLD: 32 * MEBIBYTE,  # the most that it takes
        _TRIM_THRESHOLD: 512 * MEBIBYTE,
        _TOP_PAD: 16 * MEBIBYTE,
    }
    taken = [mallopt(name, value) == 1 for name, value in settings.items()]  # every one is asked
    return all(taken)
