"""Noise-free data give K and D exactly; motion that is not what its file says is named."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from fitting.mass import read_mass_csv
from fitting.plan import read_plan
from simulate.ligament import ring_ligament, stapes_motion
from stapeskit.faults import StapeskitError
from stapeskit.records.mass_matrix import MassMatrix
from stapeskit.warnings import Notice
from tests.fit.fit_cases import (
    DOF,
    ROWS,
    TRUTH,
    K,
    M,
    codes,
    exact_motion,
    fit,
    full_mass,
    paper_motion,
    record,
    ring_ear,
    six_parameters,
)

ESTIMATORS = ("ml", "pinv", "constrained")
MASS = MassMatrix(six_parameters())


def relative(result, truth=TRUTH):
    from fitting import entries

    size = entries.sizes(result.stiffness, result.damping)
    return np.max(np.abs(result.values - truth) / size)


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_noise_free_motion_gives_k_and_d_with_a_tiny_sd(estimator):
    motion, _ = paper_motion(0.0, None)
    result = fit(motion, M, estimator=estimator)
    assert relative(result) < 1e-9
    share = np.sqrt(np.diag(result.covariance)) / np.abs(result.values)
    assert np.all(share[[0, 3, 5]] < 1e-6)
    assert np.all(share > 0.0)
    assert "noise_level" in codes(result)
    assert not {"misfit", "not_converged"} & codes(result)


@pytest.mark.parametrize("estimator", ESTIMATORS)
@pytest.mark.parametrize("in_plane", [0.0, 0.2])
def test_exact_motion_in_six_degrees_of_freedom_that_is_rigid_in_plane(estimator, in_plane):
    freq, q = exact_motion(in_plane=in_plane)
    result = fit(record(freq, q, np.zeros((1, 2, 200, 6, 6), complex)), MASS, estimator=estimator)
    assert relative(result) < 1e-5
    assert not {"misfit", "not_converged"} & codes(result)


@pytest.mark.parametrize("in_plane", [0.0, 0.2])
def test_exact_ring_with_its_plane_off_the_centre(in_plane):
    ring = ring_ligament()
    freq, q = exact_motion(in_plane=in_plane, ligament=ring)
    motion = record(freq, q, np.zeros((1, 2, 200, 6, 6), complex))
    block = np.ix_(ROWS, ROWS)
    truth = [part[block][np.triu_indices(3)] for part in (ring.stiffness_si, ring.damping_si)]
    result = fit(motion, MASS)
    assert relative(result, np.concatenate(truth)) < 1e-9
    assert result.height[0] == pytest.approx(0.1e-3, rel=1e-6)
    whole = fit(motion, MASS, dof="all")
    assert np.diag(whole.stiffness) == pytest.approx(np.diag(ring.stiffness_si), rel=1e-6)


def conjugated(motion):
    return replace(motion, q=motion.q.conj(), covariance=motion.covariance.conj())


def exchanged(motion):
    return replace(motion, bodies=motion.bodies[::-1])


def reversed_base(motion):
    sign = np.where(np.array(motion.bodies) == "base", -1.0, 1.0)[:, None, None]
    return replace(motion, q=motion.q * sign)


def in_degrees(motion, rotations=180.0 / np.pi, displacements=1.0):
    turning = [name in ("alpha", "beta", "gamma") for name in motion.dof]
    scale = np.where(turning, rotations, displacements)
    return replace(motion, q=motion.q * scale, covariance=motion.covariance * np.outer(scale, scale))


def read_through(motion, matrix):
    return replace(motion, q=motion.q @ matrix.T, covariance=matrix @ motion.covariance @ matrix.T)


@pytest.mark.parametrize(
    ("spoil", "code"),
    [
        (conjugated, "phase_convention"),
        (exchanged, "bodies_exchanged"),
        (reversed_base, "phase_convention"),
        (in_degrees, "unit_slip"),
        (partial(in_degrees, rotations=1e3), "unit_slip"),
        (partial(in_degrees, rotations=1.0, displacements=1e3), "unit_slip"),
        (partial(in_degrees, rotations=-1.0), "phase_convention"),
        (lambda motion: read_through(motion, np.diag([1.0, -1.0, 1.0])), "phase_convention"),
        (lambda motion: read_through(motion, np.eye(3)[[0, 2, 1]]), "phase_convention"),
    ],
)
@pytest.mark.parametrize("estimator", ["ml", "pinv"])
def test_a_motion_that_is_not_what_it_says_is_named_first(spoil, code, estimator):
    motion, _ = paper_motion(0.02, 1)
    result = fit(spoil(motion), M, estimator=estimator)
    assert result.verdict.level == "do not use"
    assert result.verdict.reasons[0].code == code
    assert code not in codes(fit(motion, M, estimator=estimator))


@pytest.mark.parametrize(
    ("spoil", "code"), [(conjugated, "phase_convention"), (exchanged, "bodies_exchanged")]
)
def test_the_same_in_six_degrees_of_freedom(spoil, code):
    ear = ring_ear(1, lines=40)
    result = fit(replace(spoil(ear.motion), shared=None), ear.mass, estimator="pinv")
    assert result.verdict.reasons[0].code == code


def test_degrees_of_an_ear_that_hardly_rocks_are_named_and_nothing_that_follows():
    """Rotations times 1 mm are a hundredth of the displacements: in degrees they are of a usual size."""
    freq, q = exact_motion(50)
    base = q[0, 1] * np.array([1.0, 1.0, 1.0, 0.05, 0.05, 0.05])
    exact = np.stack([stapes_motion(freq, base, full_mass(), ring_ligament()), base])
    sd = 0.01 * np.abs(exact).mean(axis=(0, 1)) + 1e-3 * np.abs(base[:, 1]).mean() * np.repeat([1, 1e3], 3)
    covariance = np.broadcast_to(np.diag(2.0 * sd**2).astype(complex), (1, 2, 50, 6, 6))
    draws = np.random.default_rng(5).standard_normal((2, 2, 50, 6))
    motion = record(freq, (exact + sd * (draws[0] + 1j * draws[1]))[None], covariance)
    right, wrong = fit(motion, MASS), fit(in_degrees(motion), MASS)
    assert "unit_slip" not in codes(right)
    assert wrong.verdict.reasons[0].code == "unit_slip"
    assert not codes(wrong) & {"cause_found", "misfit", "weak_identifiability"}


def test_what_a_motion_may_be_hides_nothing_once_it_is_confirmed():
    """Velocities of an unusual size change no K and D; who has checked them must see a misfit."""
    motion, _ = paper_motion(0.02, 1)
    quiet = replace(
        motion,
        covariance=motion.covariance / 25.0,
        notices=(Notice("unit_slip", "the velocities look like another unit"),),
    )
    found = fit(quiet, M, confirmed=["unit_slip"])
    assert not found.found.explained
    assert "misfit" in codes(found)
    assert found.verdict.level != "believe"


@pytest.mark.parametrize("spoil", [conjugated, reversed_base])
def test_an_unstable_result_is_called_so_beside_its_cause(spoil):
    motion, _ = paper_motion(0.02, 1)
    result = fit(spoil(motion), M)
    assert ("unstable" in codes(result)) is not result.modes.stable
    assert ("not_passive" in codes(result)) is not all(result.passive)


def test_lines_far_off_are_outliers_and_no_other_unit():
    ear = ring_ear(2, lines=60)
    q = ear.motion.q.copy()
    q[:, 0, [7, 21, 40]] *= 10.0
    found = codes(fit(replace(ear.motion, q=q), ear.mass, robust="t4"))
    assert "outliers" in found
    assert "unit_slip" not in found


def test_a_run_that_is_a_copy_of_another_is_refused():
    motion, _ = paper_motion(0.02, 1, 40)
    with pytest.raises(StapeskitError) as raised:
        fit(record(motion.freq_hz, motion.q.repeat(2, 0), motion.covariance.repeat(2, 0), DOF), M)
    assert "copies" in raised.value.faults[0].got


def test_frequencies_in_other_units_are_named():
    motion, _ = paper_motion(0.02, 1, 40)
    result = fit(replace(motion, freq_hz=2.0 * np.pi * motion.freq_hz), M)
    assert any("rad/s" in one.text for one in result.notices if one.code == "implausible_stiffness")
    result = fit(replace(motion, freq_hz=1e-3 * motion.freq_hz), M)
    assert result.verdict.level == "do not use"
    assert result.verdict.reasons[0].code == "unit_slip"


def test_bodies_without_a_common_line_are_refused_by_their_lines():
    motion, _ = paper_motion(0.02, 1, 40)
    q = motion.q.copy()
    q[0, 0, ::2], q[0, 1, 1::2] = np.nan, np.nan
    (fault,) = refused(lambda: fit(replace(motion, q=q), M))
    assert fault.got == "of 40 frequencies, stapes at 20, base at 20 were measured, 0 of them on all bodies"


def test_sign_of_products_of_inertia_is_stated_or_assumed_aloud():
    motion, _ = paper_motion(0.01, 2)
    other = M.copy()
    other[1, 2] = other[2, 1] = -M[1, 2]
    from fitting.dof2kd import dof2kd

    assumed, stated = dof2kd(motion, mass=M), dof2kd(motion, mass=other, mass_sign="positive")
    assert "file_read" in codes(assumed)
    assert "file_read" not in codes(stated)
    assert stated.values == pytest.approx(assumed.values, rel=1e-12)
    assert "file_read" not in codes(dof2kd(motion, mass=np.diag(np.diag(M))))


def refused(call):
    with pytest.raises(StapeskitError) as error:
        call()
    return error.value.faults


def test_what_cannot_be_fitted_is_refused_by_name():
    motion, _ = paper_motion(0.02, 1, 40)
    far = motion.q.copy()
    far[0, 0, 7] *= 1e9
    negative = motion.covariance.copy()
    negative[0, 0, 3, 0, 0] = -1.0
    together = motion.q.copy()
    together[0, 0] = together[0, 1]
    cases = {
        "--dof": lambda: fit(motion, M, dof="x,y,z"),
        "--structure and --base": lambda: fit(motion, M, structure="base"),
        "the band": lambda: fit(motion, M, band=(0.4, 5.0)),
        "the data": lambda: fit(motion, M, band=(400.0, 420.0)),
        "the motion y of stapes": lambda: fit(replace(motion, q=far), M),
        "the noise variances of stapes y": lambda: fit(replace(motion, covariance=negative), M),
        "the motion of structure and base": lambda: fit(replace(motion, q=together), M),
        "the mass matrix": lambda: fit(motion, np.eye(4)),
        "the diagonal of the mass matrix": lambda: fit(motion, 1e15 * M),
        "--inplane load": lambda: fit(motion, M, inplane="load"),
    }
    for thing, call in cases.items():
        assert refused(call)[0].thing == thing, thing
    step = refused(cases["the band"])[0].next_step
    assert "kHz" in step


def test_mass_of_a_plain_file(tmp_path):
    file = tmp_path / "M.csv"
    np.savetxt(file, M, delimiter=",")
    assert read_mass_csv(file, DOF) == pytest.approx(M)
    file.write_text("\n".join(";".join(f"{v:.12g}".replace(".", ",") for v in row) for row in M))
    assert read_mass_csv(file, DOF) == pytest.approx(M)
    for column, kind in (("re_m_s", "vibrometer file"), ("y_re_m", "motion")):
        file.write_text(f"body,freq_hz,{column}\nbase,400,1e-6\n")
        assert kind in refused(lambda: read_mass_csv(file, DOF))[0].next_step
    file.write_text("a,b,c\n1,2,3\n")
    assert refused(lambda: read_mass_csv(file, DOF))[0].where.numbers == (1,)
    file.write_text("1,2\n3,x\n")
    faults = refused(lambda: read_mass_csv(file, DOF))
    assert faults[0].where.detail == "column 2"
    file.write_text("1,2,3\n4,5,6\n")
    assert refused(lambda: read_mass_csv(file, DOF))[0].thing == "M.csv"
    wrong, (motion, _) = full_mass(), paper_motion(0.02, 1, 40)
    wrong[3, 3] *= 100.0  # of no body: its moments break the triangle inequality
    assert refused(lambda: fit(motion, wrong))
    assert refused(lambda: fit(motion, np.eye(2)))[0].got == "2 x 2"
    assert refused(lambda: read_mass_csv(tmp_path / "none.csv", DOF))[0].thing == "--mass"


def test_a_mass_of_no_stapes_and_one_that_lacks_the_plane_are_named():
    assert "implausible_mass" in codes(fit(paper_motion(0.02, 1, 40)[0], 100.0 * M))
    assert "inplane_neglected" in codes(fit(ring_ear(1, lines=24).motion, M))


@pytest.mark.parametrize("value", [np.nan, 0.0])
def test_lines_with_missing_values_are_left_out_and_counted(value):
    motion, _ = paper_motion(0.02, 1)
    q = motion.q.copy()
    q[0, 0, 4:9] = value
    result = fit(replace(motion, q=q), M)
    assert result.found.data.dropped == 5
    (text,) = [notice.text for notice in result.notices if notice.code == "file_read"]
    assert text.startswith("5 lines")
    assert result.stiffness[0, 0] == pytest.approx(K[0, 0], rel=0.02)


@pytest.mark.parametrize(
    ("text", "thing"),
    [
        ("mass = [[1, 2], [3, 4]]", "mass"),
        ("stiffness = [[1, 2], [3, 4]]", "stiffness"),
        ("damping = [[-1, 0, 0], [0, 1, 0], [0, 0, 1]]", "damping"),
        ("directions = []", "directions"),
        ("base_points_mm = [[0, 0, 0], [1, 0, 0], [2, 0, 0]]", "base_points_mm"),
    ],
)
def test_what_cannot_be_planned_is_refused_by_its_key(tmp_path, text, thing):
    path = tmp_path / "plan.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(StapeskitError) as raised:
        read_plan(path)
    assert [fault.thing for fault in raised.value.faults] == [thing]


NAMED = {
    "as pandas writes it": ",y,alpha,gamma\ny,3,1,2\nalpha,1,5,0\ngamma,2,0,6\n",
    "names above": "y,alpha,gamma\n3,1,2\n1,5,0\n2,0,6\n",
    "another order": ";gamma;y;alpha\ngamma;6;2;0\ny;2;3,0;1\nalpha;0;1;5\n",
}


@pytest.mark.parametrize("name", NAMED)
def test_names_of_degrees_of_freedom_order_a_plain_matrix(tmp_path, name):
    (tmp_path / "M.csv").write_text(NAMED[name])
    expected = np.array([[3.0, 1.0, 2.0], [1.0, 5.0, 0.0], [2.0, 0.0, 6.0]])
    assert np.array_equal(read_mass_csv(tmp_path / "M.csv", DOF), expected)


@pytest.mark.parametrize(
    "text", ["y,alpha\n3,1\n1,5\n", ",y,alpha,gamma\nalpha,3,1,2\ny,1,5,0\ngamma,2,0,6\n"]
)
def test_names_that_do_not_fit_a_plain_matrix(tmp_path, text):
    (tmp_path / "M.csv").write_text(text)
    with pytest.raises(StapeskitError):
        read_mass_csv(tmp_path / "M.csv", DOF)
