"""Types of arrays that most modules use, and numbers as JSON has them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


def finite_or_none(value: float | None) -> float | None:
    """Return a number, or None (null in JSON) where it is not finite."""
    return float(value) if value is not None and np.isfinite(value) else None
