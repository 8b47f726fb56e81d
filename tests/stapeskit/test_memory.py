"""What a process takes from the system, where the system limits it."""

from __future__ import annotations

import subprocess
import sys

import pytest

# OpenBLAS ends, stops or crashes the process where it has no room for its buffer: not in this one.
_CHILD = """
import resource, sys
import numpy, scipy.linalg.blas
from legacy.stapeskit.memory import take_algebra_buffers

def address_space():
    return int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()

resource.setrlimit(resource.RLIMIT_AS, 2 * (address_space() + (int(sys.argv[1]) << 20),))
try:
    take_algebra_buffers()
    resource.setrlimit(resource.RLIMIT_AS, 2 * (address_space() + (8 << 20),))
    factor = numpy.ones((300, 300))
    print(int((factor @ factor)[0, 0]), int(scipy.linalg.blas.dgemm(1.0, factor, factor)[0, 0]))
except MemoryError:
    print("MemoryError")
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads the address space from /proc")
@pytest.mark.parametrize(("room_mb", "said"), [(4, "MemoryError"), (56, "MemoryError"), (160, "300 300")])
def test_products_have_their_buffer_before_memory_is_short(room_mb: int, said: str) -> None:
    done = subprocess.run(
        [sys.executable, "-c", _CHILD, str(room_mb)], capture_output=True, text=True, check=True, timeout=60
    )
    assert done.stdout.strip() == said
