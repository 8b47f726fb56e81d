"""A fault is named next to lasers that scatter as stated, and no laser is blamed for it."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.fault_bodies import draw
from benchmarks.faults_gate import judged, scattered
from legacy.kinematics.fit.laser_groups import group_lasers
from legacy.kinematics.points2dof import points2dof
from tests.kinematics.simulated import body, measurement, scene


def accused(seed, fault, sd):
    """Return the verdicts of channels on a body seen by lasers off 1 %, 0.5 deg and 1 us, and culprits."""
    rng = np.random.default_rng([seed, 11])
    made = scene(seed, "" if fault == "laser" else fault, lines=40, count=6)
    (lasers,), _ = group_lasers([made.directions])
    gain, phase, delay = rng.normal(size=(3, 3)) * np.array([[0.01], [np.radians(0.5)], [1e-6]])
    lag = phase[:, None] - np.outer(delay, 2.0 * np.pi * made.freq_hz)
    made.value[:] = made.value * ((1.0 + gain)[:, None] * np.exp(1j * lag))[lasers]
    culprits = made.culprits
    if fault == "laser":
        culprits = np.flatnonzero(lasers == seed % 3).tolist()
        made.value[culprits] *= 1.12
    result = points2dof(measurement(body("stapes", made, sd=sd), freq_hz=made.freq_hz))
    return {c: v.verdict for c, v in enumerate(result.channels) if v.verdict != "ok"}, culprits


@pytest.mark.parametrize("sd", [True, False])
def test_the_fault_is_named_and_no_laser(sd):
    faults = {fault: fault for fault in ("sign", "position", "label_swap", "direction")} | {"laser": "gain"}
    for seed, (fault, verdict) in enumerate(faults.items(), 300 if sd else 305):
        found, culprits = accused(seed, fault, sd)
        assert found == dict.fromkeys(culprits, verdict)  # 2 of 24 were when lasers had to explain all


@pytest.mark.parametrize(
    ("fault", "seed"),
    [
        ("names of points", 1000),
        ("names of three points", 1001),
        ("range of points", 1001),
        ("head sign", 1001),
    ],
)
def test_a_fault_that_leaves_few_points_is_named(fault, seed):
    reading = scattered(draw(seed, "shell, 5 points, 3 heads", fault, lines=120), seed)
    found = {c: v.verdict for c, v in enumerate(judged(reading).channels) if v.verdict != "ok"}
    # None was when the channels at fault were left out of the estimate of the lasers.
    assert found == dict.fromkeys(reading.culprits, reading.verdict)
