"""The memory and the threads that the process takes from the system."""

from __future__ import annotations

import os

# Parameters of mallopt(3).
_ARENAS, _MAP_ABOVE, _TRIM_ABOVE = -8, -3, -1
# Blocks above 16 MB are given back to the system at once.
_LARGE = 16 << 20
# Given back only beyond this: pages that go and come with every small array cost more than they save.
_SPARE = 32 << 20
# OpenBLAS maps 32 MB for its buffer (measured: 16 MB are too few, 40 MB enough), and some for its tables.
_ALGEBRA_BUFFER = 48 << 20
# Rows of a product that is too large for the ways that do without the buffer.
_ALGEBRA_ROWS = 256
# Bytes reported where the system does not say.
_UNKNOWN = 1 << 50


def hold_little_memory() -> None:
    """Give large arrays back to the system as soon as they are freed, and share one pool among threads.

    For glibc (https://man7.org/linux/man-pages/man3/mallopt.3.html); elsewhere nothing is done. A command
    calls it before it starts threads.
    """
    import ctypes
    import sys

    if not sys.platform.startswith("linux"):
        return
    try:
        choose = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError):
        return
    choose(_ARENAS, 1)
    choose(_MAP_ABOVE, _LARGE)
    choose(_TRIM_ABOVE, _SPARE)


def keep_algebra_to_one_thread() -> None:
    """Let the linear algebra library run in the thread that calls it, unless the user has chosen.

    All matrices here are small: threads of OpenBLAS spin for work that never comes, on processors that
    others need. With two threads beside other programs a fit of K and D takes 2 to 6 times as long. OpenBLAS
    reads its variable when numpy is first imported; every command calls this before.
    """
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


def take_algebra_buffers() -> None:
    """Let the linear algebra libraries take their buffers, where the address space is limited.

    OpenBLAS takes its buffer at its first product, and where there is no room it ends the process with its
    own message, waits for ever or reads address 0 (github.com/OpenMathLib/OpenBLAS/issues/295 and 5289). A
    command calls this first, while a lack of memory can be reported; later products use the same buffer.
    numpy and scipy bring one library each.

    Raises
    ------
    MemoryError
        No room for the buffers.
    """
    if _address_space() == _UNKNOWN:
        return
    import mmap

    import numpy as np
    from scipy.linalg.blas import dgemm

    factor = np.zeros((_ALGEBRA_ROWS, _ALGEBRA_ROWS))
    for product in (np.matmul, lambda a, b: dgemm(1.0, a, b)):
        try:
            mmap.mmap(-1, _ALGEBRA_BUFFER).close()
        except OSError as fault:
            raise MemoryError from fault
        product(factor, factor)


def available_memory() -> int:
    """Return the bytes that this process may still take without swapping; a large number where unknown.

    Notes
    -----
    The least of what the system has left (``MemAvailable`` of /proc/meminfo, else the physical memory), what
    the control group allows, and the limit on the address space.
    """
    return min(_system_memory(), _group_memory(), _address_space())


def _system_memory() -> int:
    try:
        with open("/proc/meminfo", encoding="ascii") as lines:
            for line in lines:
                if line.startswith("MemAvailable:"):
                    return int(line.split()[1]) << 10
    except (OSError, ValueError, IndexError):
        pass
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (ValueError, OSError, AttributeError):
        return _UNKNOWN


def _group_memory() -> int:
    """Return what a control group (version 2, as containers have) leaves of its limit."""
    try:
        with open("/sys/fs/cgroup/memory.max", encoding="ascii") as limit:
            most = int(limit.read())
        with open("/sys/fs/cgroup/memory.current", encoding="ascii") as used:
            return max(0, most - int(used.read()))
    except (OSError, ValueError):  # no such group, or its limit is the word max
        return _UNKNOWN


def _address_space() -> int:
    try:
        import resource

        most = resource.getrlimit(resource.RLIMIT_AS)[0]
        with open("/proc/self/statm", encoding="ascii") as sizes:
            used = int(sizes.read().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    except (ImportError, OSError, ValueError, AttributeError):
        return _UNKNOWN
    return _UNKNOWN if most in (resource.RLIM_INFINITY, -1) else max(0, most - used)
