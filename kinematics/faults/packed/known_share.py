"""What lines with gaps tell of a change of rows, as a share of what they would tell without any."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
# Share of information below which nothing is divided.
LEAST = 1e-4
# Up to so many of its standard deviations a change is brought to equal noise; beyond, it stays a fault.
_SURE = 4.0
# A slope over the measurement is filled in only where this share of what is known of the mean is known of it.
_COVERED = 0.15


def brought(
    known: list[tuple[Array, ComplexArray]], score: ComplexArray, sd: float
) -> tuple[ComplexArray, float]:
    """Return a change of equal noise along all directions of the motion, and the share that is known.

    ``known`` are the shares and directions (see ``shares_of``) of changes that vary, then of others.
    """
    static = known[1][0]
    share = float(np.clip(np.mean(static), LEAST, 1.0)) if len(static) else 1.0
    made = np.zeros(len(score), dtype=complex)
    for shares, turn in known:
        width = len(turn)
        if not len(shares) or (width == len(score) and np.min(shares) < _COVERED * share):
            continue
        use = shares > LEAST
        along = (score[:width] @ turn)[use] / shares[use]
        noise = sd / np.sqrt(shares[use])
        far = np.minimum(1.0, _SURE * noise / np.maximum(np.abs(along), 1e-300))
        along = along * (1.0 - (1.0 - np.sqrt(shares[use] / share)) * far)
        made[:width] = along @ turn[:, use].conj().T
        break
    return made, share


def shares_of(whole: ComplexArray, known: ComplexArray) -> tuple[Array, ComplexArray]:
    """Return the shares (channel, k) known along directions of the motion, and these, of unit energy.

    ``whole`` (n, n) is what lines without gaps would tell, ``known`` (channel, n, n) what these do; the
    directions are (channel, n, k).
    """
    values, vectors = np.linalg.eigh(whole)
    keep = values > 1e-10 * max(float(values[-1]), 1e-300)
    root = vectors[:, keep] / np.sqrt(values[keep])
    shares, turn = np.linalg.eigh(root.conj().T @ known @ root)
    return np.clip(shares, 0.0, 1.0), root @ turn


__all__ = ["LEAST", "brought", "shares_of"]
