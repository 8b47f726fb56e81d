"""The compiled kernels: which there are, and whether they were built when stapeskit was installed.

Every kernel has a twin in numpy or scipy, which is used where no compiler was at hand. The library carries
a check sum of its sources in its name, so that one of other sources is never taken.
"""

from __future__ import annotations

import ctypes
import os
import sys
import zlib
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

SWITCH = "STAPESKIT_KERNELS"
_FOLDER = Path(__file__).parent
_OF = {"p": ctypes.c_void_p, "i": ctypes.c_int64, "d": ctypes.c_double, "f": ctypes.c_float}
# Arguments: p pointer, i whole number of 64 bits, d double, f float; behind the colon what it returns.
_SIGNATURES = {
    "label_pieces": "ppip:i",
    "measure_pieces": "ppipp",
    "used_box": "ppp:i",
    "grown": "pppiip:i",
    "majority": "ppp",
    "smooth_axis": "ppiipp:i",
    "interpolated": "pppip",
    "contoured": "ppdpppp:i",
    "released": "p",
    "graph_pieces": "ipip:i",
    "assembled": "iippppppp:i",
    "solved": "ipppipdip:i",
    "in_hull": "pipip:i",
    "capped_whole": "ppppdffp:i",
    "capped_float": "ppppdffp:i",
    "spread": "ppp:i",
    "every_nth": "piiip:i",
    "masked_sums": "ppppp",
    "masked_squares": "ppidp",
    **{f"lowest_{kind}": "ppipp" for kind in ("uint8", "int16", "uint16", "float32")},
    "between": "ppppffip:i",
    "smooth_slopes": "pppippp",
    "gathered": "pppppppp",
    "raw_moments": "ppippddp",
    "answers": "pppiipppdddddppp",
    "interior": "piiifffpp",
    "cubes_near": "ppiip:i",
    **{f"means_{sign}int{bits}": "ppppfp:i" for sign in ("", "u") for bits in (8, 16, 32)},
    "looked_up": "pipip",
    **{f"marked_{kind}": "ppppppppdpddip" for kind in ("uint8", "int8", "uint16", "int16")},
    "packed": "pipip:i",
    "normal_cdf": "pip",
    "normal_quantile": "pip",
}


def library_name(folder: Path = _FOLDER) -> str:
    """Return the file name of the library that belongs to the sources in a folder."""
    total = 0
    for source in sorted(folder.glob("*.[ch]")):
        total = zlib.crc32(source.read_bytes().replace(b"\r\n", b"\n"), total)
    ending = {"win32": ".dll", "darwin": ".dylib"}.get(sys.platform, ".so")
    return f"kernels-{total:08x}{ending}"


@lru_cache(maxsize=1)
def compiled() -> ctypes.CDLL | None:
    """Return the compiled kernels; None when they were not built, or ``STAPESKIT_KERNELS=numpy``."""
    if os.environ.get(SWITCH) == "numpy":
        return None
    path = _FOLDER / library_name()
    if not path.is_file():
        return None
    try:
        library = ctypes.CDLL(str(path))
    except OSError:
        return None
    for name, signature in _SIGNATURES.items():
        given, _, returned = signature.partition(":")
        function = getattr(library, name)
        function.argtypes = [_OF[letter] for letter in given]
        function.restype = _OF[returned] if returned else None
    return library


def which() -> str:
    """Return ``compiled`` or ``numpy``: what the numbers of this process are made by."""
    return "numpy" if compiled() is None else "compiled"


def checked(result: int) -> int:
    """Return what a kernel returned.

    Raises
    ------
    MemoryError
        It had too little.
    """
    if result < 0:
        raise MemoryError
    return result


def shape_of(array: NDArray[np.generic]) -> ctypes.Array[ctypes.c_int64]:
    """Return the shape of a three-dimensional array as a kernel takes it."""
    return (ctypes.c_int64 * 3)(*array.shape)
