"""Compiled kernels: libraries of C functions that were built when stapeskit was installed.

Every kernel has a twin in numpy or scipy, which is used where no compiler was at hand. The name of a library
holds a check sum of its sources and one of itself: one of other sources, or a damaged one, is never loaded.
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


def library_name(folder: Path, library: bytes) -> str:
    """Return the file name of a library that was built from the C sources in a folder.

    Parameters
    ----------
    library : bytes
        Content of the library.
    """
    return f"{_stem(folder)}-{zlib.crc32(library):08x}{_ending()}"


def built_library(folder: Path) -> Path | None:
    """Return the undamaged library of the C sources in a folder, or None when there is none."""
    for path in sorted(folder.glob(f"{_stem(folder)}-*{_ending()}")):
        try:
            if path.name == library_name(folder, path.read_bytes()):
                return path
        except OSError:
            continue
    return None


def _stem(folder: Path) -> str:
    total = 0
    for source in sorted(folder.glob("*.[ch]")):
        total = zlib.crc32(source.read_bytes().replace(b"\r\n", b"\n"), total)
    return f"kernels-{total:08x}"


def _ending() -> str:
    return {"win32": ".dll", "darwin": ".dylib"}.get(sys.platform, ".so")


def load(folder: Path, signatures: Mapping[str, str]) -> ctypes.CDLL | None:
    """Return the library of a folder; None when there is none, or ``STAPESKIT_KERNELS=numpy``.

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
    path = built_library(folder)
    if path is None:
        return None
    try:
        library = ctypes.CDLL(str(path))
    except OSError:
        return None
    for name, signature in signatures.items():
        arguments, _, returned = signature.partition(":")
        function = getattr(library, name)
        function.argtypes = [_OF[letter] for letter in arguments]
        function.restype = _OF[returned] if returned else None
    return library
