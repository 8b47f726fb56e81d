"""Errors of very many points, noise of the reference, and what beams cannot see, to the files."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from legacy.kinematics.cli import work
from legacy.kinematics.fit.beams import beam_set, observability
from legacy.kinematics.fit.frf_ratio import per_reference
from legacy.kinematics.fit.rigid_fit import fit_lines
from legacy.kinematics.fit_options import Options
from legacy.kinematics.measurement import from_arrays
from legacy.kinematics.points2dof import points2dof
from legacy.kinematics.registration.shared_errors import position_errors, position_patterns
from legacy.stapeskit.faults import StapeskitError
from legacy.stapeskit.records.motion_files import read_motion, standard_deviation, write_motion
from legacy.stapeskit.spatial import DOF_NAMES
from tests.kinematics.simulated import HEADER, body, csv_rows, measurement, readings, scene, smooth_motion

pytestmark = pytest.mark.usefixtures("undrawn")


def coherent(derivatives, variances):
    """Covariance of the real and imaginary parts of q at all lines, (2 n, 2 n)."""
    flat = derivatives.reshape(len(derivatives), -1)
    parts = np.hstack([flat.real, flat.imag])
    return (parts.T * variances) @ parts


@pytest.mark.parametrize("uneven", [False, True])
def test_patterns_of_many_points_carry_their_covariance(uneven, monkeypatch):
    made = scene(15, lines=25, count=30)
    made = replace(made, value=made.value[:27], sd=made.sd[:27], points=made.points[:27])
    made = replace(made, positions_mm=made.positions_mm[:27], directions=made.directions[:27])
    value, sd = made.value, made.sd
    if uneven:
        rng = np.random.default_rng(4)
        sd = sd * 10.0 ** rng.uniform(-1.0, 1.0, sd.shape)
        value = np.where(rng.random(value.shape) < 0.05, np.nan, value)
    data = body("stapes", made, 0.05)
    fit = fit_lines(beam_set("s", made.positions_mm, made.directions, DOF_NAMES), value, sd)
    single = position_errors({(0, 0): fit}, [data])
    assert len(single.names) == 27
    monkeypatch.setattr("legacy.kinematics.registration.shared_errors._NAMED_BYTES", 0)
    few = position_errors({(0, 0): fit}, [data])
    assert few.names[0] == "position.stapes.pattern_1"
    assert np.all(few.variances == 1.0)
    one = coherent(single.derivatives, single.variances)
    other = coherent(few.derivatives, few.variances)
    size = np.sqrt(np.max(np.diag(one).reshape(2, -1, 6), axis=(0, 1)))
    size = np.tile(size, len(one) // 6)
    assert np.max(np.abs(one - other) / np.outer(size, size)) < 5e-3


def test_hundreds_of_points_need_few_patterns():
    rng = np.random.default_rng(16)
    places = np.repeat(rng.normal(size=(600, 3)), 3, axis=0)
    beams = np.tile(np.eye(3), (600, 1))
    q = smooth_motion(rng, np.linspace(400.0, 5000.0, 40))
    value = readings(places, beams, q)
    made = from_arrays(
        {
            "s": {
                "points": [str(c // 3) for c in range(1800)],
                "positions_mm": places,
                "directions": beams,
                "value": value + 1e-9 * (rng.normal(size=(1800, 40, 2)) @ [1.0, 1j]),
                "position_sd_mm": 0.02,
            }
        },
        np.linspace(400.0, 5000.0, 40),
        order=0,
    ).bodies[0]
    fit = fit_lines(beam_set("s", places, beams, DOF_NAMES), made.displacement[0], np.array(1e-9))
    shifts = position_patterns([fit], made, {str(k): 20e-6 for k in range(600)})
    assert len(shifts) <= 40
    assert shifts[0].shape == (1800, 3)


def absolute(**changed):
    made, other = scene(17, lines=30), scene(18, lines=30)
    data = measurement(body("stapes", made), body("base", other), freq_hz=made.freq_hz)
    return points2dof(data, options=Options(**changed)).motion


def test_noise_of_the_reference_adds_to_motion_and_cancels_in_ratios(tmp_path):
    plain_motion, loud = absolute(), absolute(reference_noise=0.02)
    outer = loud.q[..., :, None] * loud.q[..., None, :].conj()
    assert np.allclose(loud.covariance - plain_motion.covariance, 2.0 * 0.02**2 * outer, rtol=1e-6)
    assert np.array_equal(loud.chi2, plain_motion.chi2)
    assert np.all(standard_deviation(loud) > standard_deviation(plain_motion))
    joint = loud.pair(0, 0, 1)[1]
    assert np.allclose(
        joint[:, :6, 6:], 2.0 * 0.02**2 * loud.q[0, 0][:, :, None] * loud.q[0, 1].conj()[:, None]
    )
    assert np.allclose(joint, joint.conj().transpose(0, 2, 1))
    one, other = per_reference(plain_motion, "base:y"), per_reference(loud, "base:y")
    keep = [k for k in range(12) if k != 7]
    first, second = (motion.covariance[0][:, keep][:, :, keep] for motion in (one, other))
    size = np.sqrt(np.einsum("faa->fa", first).real)
    assert np.max(np.abs(first - second) / size[:, :, None] / size[:, None]) < 1e-6
    assert np.max(np.abs(other.covariance[0, :, 7])) < 1e-12
    assert other.common_sd is None
    _, path = write_motion(tmp_path, "dof", loud)
    assert np.array_equal(read_motion(path).common_sd, loud.common_sd)
    with pytest.raises(StapeskitError, match="--reference-noise must be from 0 to below 1; got"):
        Options(reference_noise=1.5)


def test_a_ratio_to_motion_of_unknown_noise_has_unknown_noise():
    motion = absolute()
    blind = motion.covariance.copy()
    blind[:, 1] = np.nan
    frf = per_reference(replace(motion, covariance=blind), "base:y")
    assert np.isfinite(frf.q).all()
    assert np.isnan(frf.covariance).all()
    blind = motion.covariance.copy()
    blind[:, 0] = np.nan
    frf = per_reference(replace(motion, covariance=blind), "base:y")
    assert np.isnan(frf.covariance[:, :, :6]).all()
    assert np.isfinite(frf.covariance[:, :, 6:, 6:]).all()
    assert np.all(frf.q[:, 1, :, 1] == 1.0)


def test_strength_of_observation_does_not_depend_on_units():
    made = scene(19, lines=1)
    one = observability(made.positions_mm * 1e-3, made.directions, DOF_NAMES)
    other = observability(made.positions_mm * 1e3, made.directions, DOF_NAMES)
    assert np.allclose(one, other)


def test_what_beams_do_not_see_is_told_on_the_terminal(tmp_path):
    made = scene(20, lines=5)
    upright = replace(made, directions=np.tile([0.0, 1.0, 0.0], (27, 1)))
    value = readings(upright.positions_mm, upright.directions, made.q)
    rows = csv_rows("stapes", replace(upright, value=value))
    rows = [row for place, row in enumerate(rows) if place // 5 % 3 == 0]
    (tmp_path / "ldv.csv").write_text("\n".join([HEADER, *rows]) + "\n")
    arguments = [str(tmp_path / "ldv.csv"), "--dof", "y,alpha,gamma", "--out", str(tmp_path / "dof.csv")]
    _, outcome = work([*arguments, "--reference-noise", "0.01", "--quiet"])
    found = outcome.result["bodies"]["stapes"]["unobservable"]
    assert any("translation along the x axis (long axis of the footplate)" in text for text in found)
    assert any("rotation about the y axis (piston axis)" in text for text in found)
    assert "stapes not seen" in [name for name, _ in outcome.rows]
    assert np.all(read_motion(tmp_path / "dof.csv").common_sd == 0.01)
