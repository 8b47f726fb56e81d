"""How the process takes memory and threads from the system, where that lets itself be chosen."""

from __future__ import annotations

_ARENAS, _MAP_ABOVE, _TRIM_ABOVE = -8, -3, -1
_LARGE = 16 << 20
# Given back only beyond this: pages that go and come with every small array cost more than they save.
_SPARE = 32 << 20


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

    The matrices of a mass matrix are small: threads of OpenBLAS spin for work that never comes, on
    processors that the other threads of the program need. It reads its variable when numpy is first
    imported; a command calls this before.
    """
    import os

    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
