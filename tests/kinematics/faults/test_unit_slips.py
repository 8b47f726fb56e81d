"""Each slip of a unit is named, and right units are not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.fault_scenes import measured, scene
from kinematics.faults.unit_slips import unit_slips
from kinematics.measurement import BodyChannels, Measurement


def right(seed=1, lines=40):
    made = scene(850_000 + seed, "stapes, 10 points 3D", lines=lines)
    value = measured(made, seed)[None]
    body = BodyChannels("stapes", made.points, made.reported, made.directions, value)
    return Measurement("footplate", ("1",), made.freq_hz, (body,), 1)


def changed(data, **changes):
    return replace(data, bodies=(replace(data.bodies[0], **changes),))


def radians_as_degrees(data):
    """Return the data with velocities whose phase in radians is read as degrees."""
    rate = 2j * np.pi * data.freq_hz
    velocity = data.bodies[0].displacement * rate
    wrong = np.abs(velocity) * np.exp(1j * np.deg2rad(np.angle(velocity)))
    return changed(data, displacement=wrong / rate)


def two_bodies(data, factor):
    """Return the data with a second body whose readings are a factor larger."""
    body = data.bodies[0]
    other = replace(body, body="base", displacement=body.displacement * factor)
    return replace(data, bodies=(body, other))


def places(data, factor):
    body = data.bodies[0]
    return replace(data, bodies=(replace(body, positions_mm=body.positions_mm * factor),))


SLIPS = {
    "like m under": lambda data: places(data, 1e-3),
    "like um under": lambda data: places(data, 1e3),
    "like kHz": lambda data: replace(data, freq_hz=data.freq_hz * 1e-3),
    "too large": lambda data: changed(data, displacement=data.bodies[0].displacement * 1e6),
    "too small": lambda data: changed(data, displacement=data.bodies[0].displacement * 1e-9),
    "radians": radians_as_degrees,
    "base moves 1e+03 times": lambda data: two_bodies(data, 1000.0),
    "base moves 0.001 times": lambda data: two_bodies(data, 0.001),
}


@pytest.mark.parametrize("name", list(SLIPS))
def test_slip_is_named(name):
    (notice,) = unit_slips(SLIPS[name](right()))
    assert notice.code == "unit_slip"
    assert name in notice.text


def test_right_units_are_not_named():
    for seed in range(10):
        assert unit_slips(right(seed)) == []
        assert unit_slips(two_bodies(right(seed), 10.0)) == []


def test_real_readings_are_no_radians():
    data = right()
    rate = 2j * np.pi * data.freq_hz
    assert unit_slips(changed(data, displacement=np.abs(data.bodies[0].displacement * rate) / rate)) == []
