"""Types of arrays that most modules use, numbers as JSON has them, memory of arrays that are gone."""

from __future__ import annotations

import ctypes
from contextlib import suppress

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


def finite_or_none(value: float | None) -> float | None:
    """Return a number, or None (null in JSON) where it is not finite."""
    return float(value) if value is not None and np.isfinite(value) else None


def return_memory() -> None:
    """Let the C library give back what it keeps of arrays that are gone, where it is that of GNU."""
    with suppress(OSError, AttributeError, TypeError):  # Windows has no library without a name
        ctypes.CDLL(None).malloc_trim(0)
