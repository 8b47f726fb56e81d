"""Motions to measure: that of the bone on a shaker, and random ones of rigid bodies."""

from __future__ import annotations

import numpy as np

from stapeskit.arrays import Array, ComplexArray

BASE_PEAK_M = 1.0e-7  # 0.6 mm/s at 1 kHz, as a plan of a measurement assumes


def base_motion(freq_hz: Array, excitation: str, others: float = 1.0) -> ComplexArray:
    """Return the motion of the bone at the footplate centre, (L, 6), m and rad: some rocking, too."""
    main = "xyz".index(excitation)
    amplitude = np.array([0.06, 0.06, 0.05, 50.0, 15.0, -35.0]) * BASE_PEAK_M * others
    amplitude[main] = BASE_PEAK_M
    delay = np.array([0.4, 0.0, -0.3, 0.6, 1.1, -0.5])
    ripple = 1.0 + 0.15 * np.sin(freq_hz[:, None] / 700.0 + np.arange(6.0))
    decay = (1000.0 / freq_hz[:, None]) ** 0.5
    phase = np.exp(1j * (delay - 2.0 * np.pi * freq_hz[:, None] * 3.0e-5))
    return np.asarray(amplitude * ripple * decay * phase)


def resonant_motion(rng: np.random.Generator, freq_hz: Array) -> ComplexArray:
    """Return a random motion (L, 6), m and rad, with three resonances in all degrees of freedom."""
    motion = np.zeros((len(freq_hz), 6), dtype=complex)
    for resonance, damping in ((1753.0, 0.12), (2783.0, 0.14), (3862.0, 0.16)):
        ratio = freq_hz / resonance
        shape = rng.normal(size=6) * np.array([25e-9, 100e-9, 25e-9, 35e-6, 15e-6, 35e-6])
        motion += np.outer(1.0 / (1.0 - ratio**2 + 2j * damping * ratio), shape)
    motion[:, 1] += 100e-9
    return motion
