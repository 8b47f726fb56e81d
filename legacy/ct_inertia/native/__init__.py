"""The compiled kernels of this room: which there are, and whether they were built at installation."""

from __future__ import annotations

import ctypes
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from legacy.stapeskit.compiled_kernels import load

# Arguments: p pointer, i whole number of 64 bits, d double, f float; behind the colon what it returns.
_SIGNATURES = {
    "guarded": "pi:i",
    "unguarded": "i",
    "lost_pages": ":i",
    "label_pieces": "ppip:i",
    "measure_pieces": "ppipp",
    "used_box": "ppp:i",
    "grown": "pppiip:i",
    "majority": "ppp",
    "smooth_axis": "ppiipp:i",
    "interpolated": "pppip",
    "sampled_shares": "ppfp:i",
    "flooded": "pppp:i",
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
    "normal_cdf": "pip",
    "normal_quantile": "pip",
}


@lru_cache(maxsize=1)
def compiled() -> ctypes.CDLL | None:
    """Return the compiled kernels; None when they were not built, or ``STAPESKIT_KERNELS=numpy``."""
    return load(Path(__file__).parent, _SIGNATURES)


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
