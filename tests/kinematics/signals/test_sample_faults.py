"""Clipped tops, lone spikes and held values are told; what looks like them and is none is not."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from legacy.kinematics.signals.sample_faults import sample_notices

SAMPLES = 16384


def vibration(seed: int = 0) -> np.ndarray:
    """Return a resonance under noise, of unit standard deviation."""
    rng = np.random.default_rng([31, seed])
    made = lfilter([1.0], [1.0, -1.2, 0.8], rng.standard_normal(SAMPLES))
    return made / np.std(made)


def spiky() -> np.ndarray:
    made = vibration()
    made[[500, 4000, 4001, 9000]] += [60.0, -50.0, -50.0, 80.0]
    return made


def held() -> np.ndarray:
    made = vibration()
    for start in (700, 5000, 9001):
        made[start : start + 40] = made[start]
    return made


def codes(signal: np.ndarray, lead: np.ndarray | None = None) -> list[str]:
    """Return the codes of a channel beside a reference."""
    lead = vibration(9) if lead is None else lead
    found = sample_notices({"drive": [lead], "vib": [signal]}, ["drive"], "scan.npz")
    assert all("vib" in notice.text and "drive" not in notice.text for notice in found)
    return [notice.code for notice in found]


@pytest.mark.parametrize("limit", [1.0, 2.0, 3.0])
@pytest.mark.parametrize("jitter", [0.0, 1e-4])
def test_clipped_samples_are_told(limit: float, jitter: float) -> None:
    noise = jitter * np.random.default_rng(1).standard_normal(SAMPLES)
    assert codes(np.clip(vibration(), -limit, limit) + noise) == ["clipped"]
    assert codes(np.minimum(vibration(), limit) + noise) == ["clipped"]


def test_spikes_and_held_values_are_counted() -> None:
    found = sample_notices({"drive": [vibration(9)], "vib": [spiky()]}, ["drive"], "scan.npz")
    assert [(one.code, "vib: 3;" in one.text) for one in found] == [("spikes", True)]
    found = sample_notices({"drive": [vibration(9)], "vib": [held()]}, ["drive"], "scan.npz")
    assert [(one.code, "vib: 3;" in one.text) for one in found] == [("dropouts", True)]


@pytest.mark.parametrize(
    "made",
    [
        vibration(),
        np.round(10.0 * vibration()) / 10.0,
        np.round(50.0 * vibration()) / 50.0,
        np.tile(vibration()[:1024], 16),
        np.cos(0.3217 * np.arange(SAMPLES)),
        vibration() * (np.arange(SAMPLES) % 1024 < 512),
        np.round(40.0 * vibration() * np.exp(-(np.arange(SAMPLES) % 2048) / 100.0)),
    ],
    ids=["noise", "coarse", "fine steps", "periodic", "sine", "bursts", "decays in steps"],
)
def test_sound_signals_raise_nothing(made: np.ndarray) -> None:
    paused = np.mean(made == 0.0) > 0.4
    assert codes(made, np.where(made == 0.0, 0.0, vibration(9)) if paused else None) == []


def test_answers_to_a_hammer_are_no_spikes() -> None:
    blows = np.zeros(SAMPLES)
    for number, start in enumerate(range(100, SAMPLES, 2048)):
        blows[start : start + 8] = (1.0 + 0.1 * number) * np.hanning(8)
    answer = lfilter([1.0], [1.0, -1.2, 0.6], blows) + 1e-3 * vibration()
    assert codes(answer, blows) == []
