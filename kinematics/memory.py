"""How the process takes memory from the system, where the C library lets it be chosen."""

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
