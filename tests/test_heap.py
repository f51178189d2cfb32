"""The heap gives large blocks back, whatever was freed before; in a process of its own, as it stays so."""

from __future__ import annotations

import ctypes
import subprocess
import sys

import pytest

MAPPED = """
import ctypes
import numpy as np
from robominer_slam.heap import LARGE_BLOCK, give_large_blocks_back

class Statistics(ctypes.Structure):
    _fields_ = [(name, ctypes.c_size_t) for name in (*"abcd", "mapped", *"efghi")]

library = ctypes.CDLL(None)
library.mallinfo2.restype = Statistics
{call}
for _ in range(3):
    np.ones(LARGE_BLOCK)  # freed at once: the library takes blocks of this size from the heap from now on
before = library.mallinfo2().mapped
held = np.ones(LARGE_BLOCK // 4)
print((library.mallinfo2().mapped - before) / held.nbytes)
"""


@pytest.mark.skipif(not hasattr(ctypes.CDLL(None), "mallinfo2"), reason="another C library than glibc from 2.33 on")
@pytest.mark.parametrize(("call", "mapped"), [("give_large_blocks_back()", 1.0), ("", 0.0)])
def test_large_blocks_are_mapped_on_their_own(call, mapped):
    program = [sys.executable, "-c", MAPPED.format(call=call)]
    share = float(subprocess.run(program, capture_output=True, text=True, check=True).stdout)
    assert share == pytest.approx(mapped, abs=0.1)
