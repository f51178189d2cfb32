"""How the C library's heap holds on to memory that is let go."""

from __future__ import annotations

import ctypes

#: Blocks from this size on, bytes, are mapped each on its own; SuperLU's arrays for a full map are larger.
LARGE_BLOCK = 2 * 1024 * 1024
# Of glibc's malloc.h.
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3


def give_large_blocks_back() -> None:
    """Have large blocks mapped by themselves, so that what of them is not written takes no memory, nor what is freed.

    Left alone, glibc takes the largest block that was ever freed, up to 32 MB, for the size below which blocks come
    from the heap. SuperLU reserves for the worst case: 24 MB for the factors of a full map, whose numbers are 2 MB.
    From the heap that is recycled memory, which is resident. Other C libraries are left as they are.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_M_MMAP_THRESHOLD, LARGE_BLOCK)
        mallopt(_M_TRIM_THRESHOLD, LARGE_BLOCK)
