"""Memory that is freed stays with the process: a training step asks for the same large arrays again and again.

glibc returns blocks of 32 MiB and more (and the top of the heap) to the system when they are freed; getting them back
costs a page fault for every 4 KiB. What that makes of a training
step: ``benchmarks/release/training_speed.py``.
"""

from __future__ import annotations

import ctypes
import sys

M_TRIM_THRESHOLD, M_TOP_PAD, M_MMAP_THRESHOLD = -1, -2, -3  # of <malloc.h>
LARGEST, PAD = (1 << 30, 1 << 25), 200_000_000  # older glibc takes no threshold above 32 MiB


def keep_freed_memory() -> bool:
    """Tell the C library to keep what is freed, for this process; False where it will not (not glibc)."""
    if not sys.platform.startswith("linux"):
        return False
    library = ctypes.CDLL(None)
    if not (hasattr(library, "mallopt") and hasattr(library, "gnu_get_libc_version")):
        return False
    kept = [library.mallopt(M_TRIM_THRESHOLD, (1 << 31) - 1), library.mallopt(M_TOP_PAD, PAD)]
    return any(library.mallopt(M_MMAP_THRESHOLD, largest) for largest in LARGEST) and all(kept)
