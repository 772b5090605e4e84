"""Free memory, errors for lack of memory, and the C library's allocator."""

import ctypes
import sys
from pathlib import Path

from tom.errors import reason

# glibc's `mallopt` and its parameters (malloc.h).
_TRIM_THRESHOLD, _TOP_PAD, _MMAP_THRESHOLD = -1, -2, -3
MEBIBYTE = 2**20

STUDIO_CACHE_BYTES = 192 * MEBIBYTE
"""maximum size of the cache in each of the studio's two servers"""


def available() -> int:
    """Bytes of free memory; more than any machine has if that is unknown."""
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
    except OSError:
        return sys.maxsize
    free = [line.split()[1] for line in lines if line.startswith("MemAvailable:")]
    return int(free[0]) * 1024 if free else sys.maxsize


MEMORY_ERRORS = (MemoryError, RuntimeError)
"""types of the errors that a lack of memory may be; `is_out_of_memory` tells which of them are"""

_REFUSALS = (
    "CUDA out of memory",
    "can't allocate memory",
    "not allocate memory",
    "can't start new thread",
)
"""parts of the messages of torch, MuJoCo and the kernel when memory runs out"""


def is_out_of_memory(error: BaseException) -> bool:
    """Whether the error means that there was not enough memory."""
    return isinstance(error, MemoryError) or any(words in str(error) for words in _REFUSALS)


def out_of_memory(error: BaseException) -> str:
    """A message for such an error, with the fix."""
    return (
        f"not enough memory ({reason(error)}): take smaller networks, batches or buffers, or free "
        "some"
    )


def keep_freed_memory() -> None:
    """Keep freed memory in this process instead of returning it, where glibc can.

    By default glibc returns blocks of some hundred kilobytes to the system and gets them back page
    by page, which made network evaluations of some sizes a third slower.
    """
    if sys.platform != "linux":
        return
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is None:  # another C library
        return
    settings = {
        _MMAP_THRESHOLD: 32 * MEBIBYTE,  # the largest value that it accepts
        _TRIM_THRESHOLD: 512 * MEBIBYTE,
        _TOP_PAD: 16 * MEBIBYTE,
    }
    for name, value in settings.items():
        mallopt(name, value)
