"""The compiled kernels of this room: which there are, and whether they were built at installation."""

from __future__ import annotations

import ctypes
from functools import lru_cache
from pathlib import Path

from legacy.stapeskit.compiled_kernels import load

# Arguments: p pointer, i whole number of 64 bits, d double; behind the colon what it returns.
_SIGNATURES = {
    "fit_shared": "pipiiiippppppippp:i",
    "fit_lines": "piiiipiippippddppppppppi",
}


@lru_cache(maxsize=1)
def compiled() -> ctypes.CDLL | None:
    """Return the compiled kernels; None when they were not built, or ``STAPESKIT_KERNELS=numpy``."""
    return load(Path(__file__).parent, _SIGNATURES)
