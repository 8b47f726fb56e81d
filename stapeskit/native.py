"""Compiled kernels: libraries of C functions that were built when stapeskit was installed.

Every kernel has a twin in numpy or scipy, which is used where no compiler was at hand. A library carries a
check sum of its sources in its name, so that one of other sources is never taken.
"""

from __future__ import annotations

import ctypes
import os
import sys
import zlib
from collections.abc import Mapping
from pathlib import Path

SWITCH = "STAPESKIT_KERNELS"
_OF = {"p": ctypes.c_void_p, "i": ctypes.c_int64, "d": ctypes.c_double, "f": ctypes.c_float}


def library_name(folder: Path) -> str:
    """Return the file name of the library that belongs to the C sources in a folder."""
    total = 0
    for source in sorted(folder.glob("*.[ch]")):
        total = zlib.crc32(source.read_bytes().replace(b"\r\n", b"\n"), total)
    ending = {"win32": ".dll", "darwin": ".dylib"}.get(sys.platform, ".so")
    return f"kernels-{total:08x}{ending}"


def load(folder: Path, signatures: Mapping[str, str]) -> ctypes.CDLL | None:
    """Return the library of a folder; None when it was not built, or ``STAPESKIT_KERNELS=numpy``.

    Parameters
    ----------
    folder : Path
        Of the C sources and the library.
    signatures : mapping of str to str
        Arguments by function: p pointer, i whole number of 64 bits, d double, f float; behind a colon what it
        returns.
    """
    if os.environ.get(SWITCH) == "numpy":
        return None
    path = folder / library_name(folder)
    if not path.is_file():
        return None
    try:
        library = ctypes.CDLL(str(path))
    except OSError:
        return None
    for name, signature in signatures.items():
        given, _, returned = signature.partition(":")
        function = getattr(library, name)
        function.argtypes = [_OF[letter] for letter in given]
        function.restype = _OF[returned] if returned else None
    return library
