"""A measured frequency response of one degree of freedom, poor coherence and all, fitted with intervals.

Hammer and accelerometer data distributed with the Vibration Toolbox (case1.mat). A force F on the mass is the
same as a base motion u = F / (w^2 m) under coordinates that move with the base, q_s - q_b = x.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from legacy.fitting.fit_kd import KDFit, fit_kd
from legacy.fitting.options import KDOptions
from legacy.stapeskit.records.motion import RigidMotion

FILE = Path(__file__).resolve().parents[3] / "shared" / "data" / "frf" / "case1.mat"
BAND = (208.0, 217.0)


def response() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Frequencies (Hz), receptance up to a gain, coherence, of the band around the resonance."""
    from scipy.io import loadmat

    data = loadmat(FILE)
    freq = data["Freq_domain"].ravel().astype(float)
    keep = (freq >= BAND[0]) & (freq <= BAND[1])
    return freq[keep], data["Hf_chan_2"].ravel()[keep], data["Hf_coh_chan_2"].ravel().astype(float)[keep]


def fit(mass: float) -> KDFit:
    freq, receptance, coherence = response()
    omega = 2.0 * np.pi * freq
    coherence = np.clip(coherence, 0.05, 0.99)
    variance = np.abs(receptance) ** 2 * (1.0 - coherence) / coherence
    base = 1.0 / (omega**2 * mass)
    q = np.array([receptance + base, base.astype(complex)])[None, :, :, None]
    covariance = np.zeros((1, 2, len(freq), 1, 1), dtype=complex)
    covariance[0, 0, :, 0, 0] = variance
    none = np.full((1, 2, len(freq)), np.nan)
    motion = RigidMotion(("hammer",), ("mass", "base"), ("y",), freq, q, covariance, none, none)
    options = KDOptions(dof=("y",), structure="mass", base="base")
    return fit_kd(motion, np.array([[mass]]), options)


def best_mass() -> float:
    """The gain of the file is not calibrated: the mass that fits best."""
    from scipy.optimize import minimize_scalar

    found = minimize_scalar(lambda power: fit(10.0**power).chi2, bounds=(-8.2, -7.2), method="bounded")
    return float(10.0**found.x)


def frequency_at(degrees: float) -> float:
    """Where the measured phase passes a value, Hz: linear between lines."""
    freq, receptance, _ = response()
    phase = np.degrees(np.unwrap(np.angle(receptance)))
    return float(np.interp(-degrees, -phase, freq))


@pytest.mark.shared
def test_frequency_and_damping_agree_with_the_measured_phase() -> None:
    result = fit(best_mass())
    mode = result.modes.pairs[0]
    assert mode.frequency_hz == pytest.approx(frequency_at(-90.0), abs=0.1)
    half_power = (frequency_at(-135.0) - frequency_at(-45.0)) / (2.0 * frequency_at(-90.0))
    assert mode.damping_ratio == pytest.approx(half_power, rel=0.35)
    assert 0.0 < result.derived.frequency_sd_hz[0] < 0.2
    assert np.all(np.isfinite(result.intervals))
    assert result.modes.stable


@pytest.mark.shared
def test_coherence_overstates_the_noise_of_this_measurement() -> None:
    """Coherence of 0.3 says that half of each line is noise; the lines scatter by a few percent."""
    result = fit(best_mass())
    assert result.chi2 / result.n_dof < 0.3
    assert "noise_overstated" in {notice.code for notice in result.notices}
