"""Memory that XLA frees on CPUs: kept for the next call, or given back to the system and faulted in again."""

import ctypes
import os
import platform
import sys

_TRIM_THRESHOLD, _TOP_PAD, _MMAP_MAX, _ARENA_MAX = -1, -2, -4, -8  # of glibc's mallopt
_GROWTH = 64 << 20  # bytes
_kept = False


def keep_memory() -> bool:
    """Make this process keep the memory that it frees; networks take two thirds of the time on a CPU with it.

    XLA on CPUs allocates its buffers in every call. Those of more than 32 MB (a 24-channel image at 720p has 88) the C
    library takes from the system and gives back, so that each of their pages is cleared and mapped anew: on a virtual
    machine that takes as long as a convolution does. This sets glibc's allocator to use one heap, and never to shrink
    it (`mallopt`: one arena, no mappings, no trimming). The command line calls it; programs that import the library
    may, once, at their start.

    Returns:
        Whether it is in force. Not on systems without glibc, nor where the environment has settings of its own
        (`MALLOC_...`, or `glibc.malloc` in `GLIBC_TUNABLES`).

    Cost:
        The process holds the most memory that it ever used, and all threads allocate from one heap.
    """
    global _kept
    if _kept:
        return True
    chosen = any(name.startswith("MALLOC_") for name in os.environ)
    chosen = chosen or "glibc.malloc" in os.environ.get("GLIBC_TUNABLES", "")
    if chosen or not sys.platform.startswith("linux") or platform.libc_ver()[0] != "glibc":
        return False
    mallopt = ctypes.CDLL(None).mallopt
    settings = ((_ARENA_MAX, 1), (_MMAP_MAX, 0), (_TRIM_THRESHOLD, -1), (_TOP_PAD, _GROWTH))
    _kept = all([mallopt(name, value) == 1 for name, value in settings])
    return _kept


def memory_kept() -> bool:
    """Whether `keep_memory` is in force."""
    return _kept
