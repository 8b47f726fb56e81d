"""Each slip of a unit is named, and right units are not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.fault_scenes import measured, scene
from legacy.kinematics.faults.alternatives import slip_notices
from legacy.kinematics.measurement import BodyChannels, Measurement


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
    "a thousand times too large": lambda data: replace(data, freq_hz=data.freq_hz * 1e3),
    "radians": radians_as_degrees,
    "base moves 1e+03 times": lambda data: two_bodies(data, 1000.0),
    "base moves 0.001 times": lambda data: two_bodies(data, 0.001),
}


@pytest.mark.parametrize("name", list(SLIPS))
def test_slip_is_named(name):
    (notice,) = slip_notices(SLIPS[name](right()))
    assert notice.code == "unit_slip"
    assert name in notice.text


@pytest.mark.parametrize("factor", [1e6, 1e3, 1e-3, 1e-6])
@pytest.mark.parametrize("millimetres_per_second", [0.03, 0.1, 0.5])
def test_a_factor_of_all_bodies_is_seen_by_their_velocity(factor, millimetres_per_second):
    data = two_bodies(right(), 1.2)
    speed = np.median(np.abs(data.bodies[0].displacement) * 2.0 * np.pi * data.freq_hz)
    size = millimetres_per_second * 1e-3 / speed

    def times(by):
        bodies = [replace(body, displacement=body.displacement * by) for body in data.bodies]
        return replace(data, bodies=tuple(bodies))

    assert slip_notices(times(size)) == []
    (notice,) = slip_notices(times(size * factor))
    assert notice.code == "plausibility"
    assert f"{max(factor, 1.0 / factor):g} times too {'large' if factor > 1.0 else 'small'}" in notice.text


def test_noise_below_that_of_vibrometers_is_seen():
    data = right()
    rate = 2.0 * np.pi * data.freq_hz
    for noise, seen in ((1e-8, []), (1e-11, ["plausibility"])):
        sd = np.broadcast_to(noise / rate, data.bodies[0].displacement.shape)
        assert [notice.code for notice in slip_notices(changed(data, sd=sd))] == seen


@pytest.mark.parametrize("unit", [1.0, 1e-3, 1e-6])
def test_decibels_under_a_linear_header_are_named(unit):
    data = right()
    rate = 2j * np.pi * data.freq_hz
    velocity = data.bodies[0].displacement * rate
    size = np.abs(velocity)
    level = 20.0 * np.log10(size / np.median(size)) + 90.0
    notices = slip_notices(changed(data, displacement=unit * level * velocity / size / rate))
    assert ["taken as decibels" in notice.text for notice in notices] == [True]


def test_right_units_are_not_named():
    for seed in range(10):
        assert slip_notices(right(seed)) == []
        assert slip_notices(two_bodies(right(seed), 0.1)) == []


def test_real_readings_are_no_radians():
    data = right()
    rate = 2j * np.pi * data.freq_hz
    assert slip_notices(changed(data, displacement=np.abs(data.bodies[0].displacement * rate) / rate)) == []
