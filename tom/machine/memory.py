"""The C library's memory: what a training frees it asks for again at once."""

import ctypes
import sys

# glibc's `mallopt` and its parameters (malloc.h).
_TRIM_THRESHOLD, _TOP_PAD, _MMAP_THRESHOLD = -1, -2, -3
MEBIBYTE = 2**20


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
