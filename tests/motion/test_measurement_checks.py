"""Cheap checks of a measurement: what they warn of, and that sound files pass."""

from dataclasses import replace

import numpy as np
import pytest

from kinematics.faults.checks import check_measurement, empty_faults, screen_zeros
from kinematics.measurement import BodyChannels, Measurement
from kinematics.motion_checks import phase_notices
from simulate import Ear, Experiment, simulate_recording, simulate_truth
from stapeskit.frames import RigidTransform
from stapeskit.records.rigid_motion import RigidMotion
from stapeskit.spatial import DOF_NAMES
from tests.motion.bodies import as_measurement, recorded


@pytest.fixture(scope="module")
def ear():
    """Stapes and base of a simulated ear."""
    recording = simulate_recording(simulate_truth(Ear()), Experiment(in_footplate=True, lines=120))
    bodies = {}
    for name in ("stapes", "base"):
        own = recording.channels(name)
        bodies[name] = {
            "points": tuple(recording.point[c] for c in own),
            "positions_m": 1e-3 * recording.position_mm[own],
            "directions": recording.direction[own],
            "value": recording.velocity_m_s[:, own],
            "sd": recording.sd_m_s[:, own],
        }
    channels = tuple(BodyChannels(name, **parts) for name, parts in bodies.items())
    return Measurement("footplate", ("1",), recording.freq_hz, channels)


def with_values(measurement, change, **other):
    """Return a measurement with changed values."""
    bodies = tuple(replace(body, value=change(body.value)) for body in measurement.bodies)
    return replace(measurement, bodies=bodies, **other)


def codes(measurement):
    """Return the codes of the warnings."""
    return {notice.code for notice in check_measurement(measurement)}


def test_a_sound_file_passes(ear):
    assert check_measurement(ear) == []


@pytest.mark.parametrize(
    ("change", "code"),
    [
        (lambda value: value * 1e3, "unit_slip"),
        (lambda value: value * 1e-6, "unit_slip"),
        (
            lambda value: (
                (120.0 + 20.0 * np.log10(np.abs(value) / 1e-3) / 3.0) * np.exp(1j * np.angle(value))
            ),
            "unit_slip",
        ),
    ],
)
def test_units_of_values(ear, change, code):
    assert code in codes(with_values(ear, change))


@pytest.mark.parametrize("bodies", [("stapes", "base"), ("stapes",)])
def test_amplitudes_of_the_other_sign_of_time_are_told(bodies):
    """A passive ligament makes the stapes lag its base; a single body lags its excitation."""
    freq_hz = np.linspace(400.0, 6000.0, 60)
    lag = np.exp(-0.5j * np.pi * np.arange(60) / 20.0)[:, None]
    base = np.array([0.0, 1e-7, 0.0, 0.0, 0.0, 0.0]) * lag
    omega = 2.0 * np.pi * freq_hz
    ratio = 1.0 / (1.0 - (omega / 2e4) ** 2 + 0.1j)
    q = np.stack([base * ratio[:, None], base])[: len(bodies)]
    covariance = np.broadcast_to(1e-22 * np.eye(6), (1, len(q), 60, 6, 6)).astype(complex)
    sums = np.ones((1, len(q), 60))
    for sign, expected in ((1.0, []), (-1.0, ["phase_convention"])):
        values = (q.real + 1j * sign * q.imag)[None]
        motion = RigidMotion(("1",), bodies, DOF_NAMES, freq_hz, values, covariance, sums, sums.astype(int))
        assert [notice.code for notice in phase_notices(motion)] == expected


@pytest.mark.parametrize("turns", [1.0, 2.0, 2.0 * np.pi, 0.0])
def test_phases_that_no_column_of_degrees_holds_are_named(ear, turns):
    """Turns, multiples of pi or radians read as degrees; magnitudes alone."""

    def as_degrees(value):
        return np.abs(value) * np.exp(1j * np.deg2rad(turns * np.angle(value) / (2.0 * np.pi)))

    assert "unit_slip" in codes(with_values(ear, as_degrees))


@pytest.mark.parametrize("sd_deg", [0.0, 0.1, 0.3, 1.0])
def test_a_base_in_phase_with_the_reference_is_sound(ear, sd_deg):
    """One direction of a shaker, phases over an accelerometer on the base, or responses over the base."""
    stapes, base = ear.bodies
    draws = np.random.default_rng(1).standard_normal(base.value.shape)
    value = 5e-4 * base.directions[:, 1:2] * np.exp(1j * np.deg2rad(sd_deg * draws))
    assert codes(replace(ear, bodies=(stapes, replace(base, value=value)))) == set()


def test_magnitudes_of_one_body_without_phases_are_named(ear):
    stapes, base = ear.bodies
    bare = replace(base, value=np.abs(base.value).astype(complex))
    assert "unit_slip" in codes(replace(ear, bodies=(stapes, bare)))


def test_units_of_frequencies(ear):
    assert "unit_slip" in codes(replace(ear, freq_hz=ear.freq_hz * 1e-3))


def test_one_body_in_another_unit(ear):
    stapes, base = ear.bodies
    louder = replace(ear, bodies=(stapes, replace(base, value=base.value * 1e-3)))
    assert any(notice.code == "unit_slip" and "base" in notice.text for notice in check_measurement(louder))


def test_exchanged_bodies():
    one, other = (as_measurement(recorded(seed)).bodies[0] for seed in (1, 2))
    names = {"a": (one, other), "b": (other, one)}
    bodies = tuple(
        replace(place, body=name, value=values.value, sd=None) for name, (place, values) in names.items()
    )
    assert "bodies_exchanged" in codes(Measurement("footplate", ("1",), recorded(1).freq_hz, bodies))


def test_rows_of_zeros_are_set_aside_where_the_body_moves():
    body = as_measurement(recorded(1)).bodies[0]
    value = body.value.copy()
    value[:, 4] = 0.0
    value[:, 7] = np.nan
    screened = screen_zeros(replace(body, value=value), ("1",), DOF_NAMES)
    assert screened.unused == ({4: "zeros", 7: "unused"},)
    assert np.isnan(screened.body.value[:, 4]).all()
    assert [notice.code for notice in screened.notices] == ["zero_rows"]


def test_values_that_fill_gaps_are_set_aside():
    body = as_measurement(recorded(1)).bodies[0]
    value = body.value.copy()
    value[:, 4, 20:40] = -9999.0 - 9999.0j
    screened = screen_zeros(replace(body, value=value), ("1",), DOF_NAMES)
    assert np.array_equal(np.isnan(screened.body.value), value == value[0, 4, 20])
    assert [notice.code for notice in screened.notices] == ["zero_rows"]
    coarse = replace(body, value=np.round(body.value, 5))
    assert screen_zeros(coarse, ("1",), DOF_NAMES).body.value.shape == body.value.shape
    assert not np.isnan(screen_zeros(coarse, ("1",), DOF_NAMES).body.value[coarse.value != 0.0]).any()


def test_channels_of_one_value_are_set_aside_where_the_body_moves_otherwise():
    body = as_measurement(recorded(1)).bodies[0]
    value = body.value.copy()
    value[:, 4] = 1e-4
    screened = screen_zeros(replace(body, value=value), ("1",), DOF_NAMES)
    assert screened.unused == ({4: "zeros"},)
    assert [notice.code for notice in screened.notices] == ["zero_rows"]


def test_zeros_are_believed_where_nothing_moves():
    body = as_measurement(recorded(1, exact=True)).bodies[0]
    only_y = recorded(1, exact=True).direction @ np.eye(3)
    value = np.outer(only_y[:, 0], np.ones(body.value.shape[2]) * 1e-4)[None] + 0j
    still = np.abs(only_y[:, 0]) < 1e-9
    value[:, still] = 0.0
    screened = screen_zeros(replace(body, value=value), ("1",), DOF_NAMES)
    assert all(channel not in screened.unused[0] for channel in np.flatnonzero(still))


def test_a_body_without_values_is_a_fault():
    measurement = as_measurement(recorded(1))
    (fault,) = empty_faults(with_values(measurement, lambda value: value * np.nan))
    assert "stapes" in fault.thing


def test_mapping_moves_points_and_beams_together():
    measurement = as_measurement(recorded(2))
    turn = RigidTransform.from_parts(np.eye(3)[[1, 2, 0]], [1.0, -2.0, 3.0], "new", "footplate")
    moved = measurement.mapped(turn)
    body, old = moved.bodies[0], measurement.bodies[0]
    assert moved.frame == "new"
    assert np.allclose(1e3 * body.positions_m, turn.points(1e3 * old.positions_m))
    assert np.allclose(body.directions @ body.file_from_here.T, old.directions)
    assert np.allclose(measurement.mirrored("x").mirrored("x").bodies[0].positions_m, old.positions_m)
