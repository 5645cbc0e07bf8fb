"""Memory that is freed stays with the process: a training step asks for the same large arrays again and again.

glibc returns blocks of 32 MiB and more (and the top of the heap) to the system when they are freed; getting them back
costs a page fault for every 4 KiB. Measured: 12 to 15 % of a training step on two cores
(``benchmarks/training_speed.py``).
"""

from __future__ import annotations

import ctypes
import sys

M_TRIM_THRESHOLD, M_TOP_PAD, M_MMAP_THRESHOLD = -1, -2, -3  # of <malloc.h>
LARGEST, PAD = 1 << 30, 200_000_000


def keep_freed_memory() -> bool:
    """Tell the C library to keep what is freed, for this process; False where it cannot be told (not glibc)."""
    if not sys.platform.startswith("linux"):
        return False
    library = ctypes.CDLL(None)
    if not (hasattr(library, "mallopt") and hasattr(library, "gnu_get_libc_version")):
        return False
    settings = ((M_MMAP_THRESHOLD, LARGEST), (M_TRIM_THRESHOLD, 2 * LARGEST - 1), (M_TOP_PAD, PAD))
    return all(library.mallopt(name, value) for name, value in settings)
