"""What a finding says: corrections in the user's own file, and no size below its standard deviation."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.fault_scenes import measured, scene
from legacy.kinematics.faults.catalogue import Fault
from legacy.kinematics.faults.findings import Finding, describe
from legacy.kinematics.faults.sentences import with_sd
from legacy.kinematics.measurement import BodyChannels, Measurement
from legacy.kinematics.points2dof import points2dof
from legacy.kinematics.registration.placement import Placement
from legacy.stapeskit.frames import RigidTransform, rotation_from_vector

STAPES = "stapes, 10 points 3D"


def body(count=4):
    rng = np.random.default_rng(1)
    names = tuple(str(k // 3) for k in range(3 * count))
    places = np.repeat(rng.normal(size=(count, 3)), 3, axis=0)
    value = np.zeros((1, 3 * count, 5), dtype=complex)
    return BodyChannels("stapes", names, places, np.tile(np.eye(3), (count, 1)), value)


def fitted(kind, channels, parameters, sd):
    """Return a finding with a fit of independent parameters."""
    parameters = np.asarray(parameters, dtype=float)
    fault = Fault(kind, "point" if kind == "position" else "channel", channels)
    covariance = np.diag(np.asarray(sd, dtype=float) ** 2)
    return Finding(kind, channels, 1e-6, fault, parameters=parameters, covariance=covariance, drop=10.0)


@pytest.mark.parametrize(
    ("kind", "channels", "parameters", "sd"),
    [
        ("gain", [0], [0.05], [0.06]),
        ("phase", [0], [0.05, 0.0], [0.01, 0.2]),
        ("delay", [0], [0.1], [0.2]),
        ("direction", [0], [0.02, 0.0], [0.03, 0.03]),
        ("position", [0, 1, 2], [1e-4, 0.0, 0.0], [2e-4, 1e-5, 1e-5]),
        ("position", [0, 1, 2], [1.0, 2.0, 3.0], [14.0, 14.0, 14.0]),
    ],
)
def test_a_size_below_its_sd_is_not_printed(kind, channels, parameters, sd):
    _verdict, estimate = describe(fitted(kind, channels, parameters, sd), body())
    assert "+-" not in estimate
    assert "not determine" in estimate


def test_a_coordinate_that_the_beams_cannot_see_is_left_open():
    found = fitted("position", [0, 1, 2], [2e-4, 9.0, 1e-4], [1e-5, 14.0, 1e-5])
    some = body()
    estimate = describe(found, some)[1]
    assert "y_mm not determined" in estimate
    assert f"x_mm {some.positions_mm[0, 0] + 0.2:.4g} +- 0.01" in estimate


def test_sizes_above_their_sd_are_printed():
    assert with_sd(0.2, 0.01, "mm") == "0.2 +- 0.01 mm"


@pytest.mark.parametrize("mirror", ["", "z"])
def test_corrected_coordinates_are_those_of_the_users_file(mirror):
    made = scene(840_001, STAPES, "position 200 um")
    turn = rotation_from_vector(np.array([0.4, -1.1, 2.0]))
    footplate_from_file = RigidTransform.from_parts(turn, [3.0, -7.0, 11.0], "footplate", "vibrometer")
    back = footplate_from_file.inverse()
    channels = BodyChannels(
        "stapes",
        made.points,
        back.points(made.reported),
        back.vectors(made.directions),
        measured(made, 1)[None],
        made.sd[None],
    )
    data = Measurement("vibrometer", ("1",), made.freq_hz, (channels,), 0)
    if mirror:
        sign = np.array([1.0, 1.0, -1.0])
        flipped = replace(
            channels,
            positions_mm=channels.positions_mm * sign,
            directions=channels.directions * sign,
            reported_positions_mm=channels.positions_mm * sign,
            reported_directions=channels.directions * sign,
        )
        data = replace(data, bodies=(flipped,)).mirrored(mirror)
    result = points2dof(data, Placement(footplate_from_file))
    (finding,) = result.diagnoses[0, 0].findings
    estimate = describe(finding, result.measurement.bodies[0])[1]
    found = np.array([float(x) for x in re.findall(r"[xyz]_mm (-?[\d.e+-]+) \+-", estimate)])
    sd = np.array([float(x) for x in re.findall(r"_mm -?[\d.e+-]+ \+- ([\d.e+-]+)", estimate)])
    true = back.points(made.true[made.culprits[0]][None])[0] * (np.array([1.0, 1.0, -1.0]) if mirror else 1.0)
    assert len(found) == 3
    assert np.all(np.abs(found - true) < 4.0 * sd + 0.006)
    assert np.max(sd) < 0.1
