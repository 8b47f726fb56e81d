"""Simulated bodies for the tests of fit, joint estimate and faults."""

from __future__ import annotations

import numpy as np

from kinematics.fit.beams import beam_set
from kinematics.fit.noise import fit_with_noise
from kinematics.measurement import BodyChannels, Measurement
from simulate import (
    Experiment,
    MeasurementFault,
    Recording,
    measure_motion,
    resonant_motion,
    scattered_points,
)
from stapeskit.spatial import DOF_NAMES


def recorded(seed, points=9, flat=False, faults=(), **experiment):
    """Return what a vibrometer writes of one body ``stapes`` with random points and motion."""
    rng = np.random.default_rng([seed, 3])
    given = {
        "lines": 120,
        "in_footplate": True,
        "position_sd_mm": 0.0,
        "noise_spread": (1.0, 1.0),
    } | experiment
    settings = Experiment(seed=seed, faults=tuple(MeasurementFault(**fault) for fault in faults), **given)
    motion = resonant_motion(rng, settings.freq_hz)
    return measure_motion({"stapes": motion[None]}, {"stapes": scattered_points(rng, points, flat)}, settings)


def as_measurement(recording: Recording, stated=True) -> Measurement:
    """Return a recording of one body as a measurement."""
    body = BodyChannels(
        "stapes",
        recording.point,
        1e-3 * recording.position_mm,
        recording.direction,
        recording.velocity_m_s,
        recording.sd_m_s if stated else None,
        position_sd_m=np.full(len(recording.point), 1e-3 * recording.position_sd_mm),
    )
    return Measurement("footplate", recording.runs, recording.freq_hz, (body,))


def fitted(measurement: Measurement, dof=DOF_NAMES, robust="none"):
    """Return a body and the fits of its runs."""
    body = measurement.bodies[0]
    beams = beam_set(body.body, body.arms_m, body.directions, dof)
    runs = range(len(measurement.runs))
    return body, [fit_with_noise(measurement, run, body, beams, robust)[0] for run in runs]
