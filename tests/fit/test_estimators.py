"""Estimators of textbooks: least squares, bias by noise, constraints; five and six degrees of freedom."""

from dataclasses import replace

import numpy as np
import pytest

from fitting import entries
from fitting.model import modes, passive
from fitting.solve import entry_scale
from tests.fit.fit_cases import (
    TRUTH,
    D,
    K,
    M,
    codes,
    deviation,
    fit,
    paper_motion,
)


def test_pinv_is_the_paper_s_equation_5():
    motion, _ = paper_motion(0.02, 1, 60)
    result = fit(motion, M, estimator="pinv")
    q, base = motion.q[0]
    omega = 2.0 * np.pi * motion.freq_hz
    rows, right = [], []
    for line in range(60):
        dq = q[line] - base[line]
        block = np.zeros((3, 12), dtype=complex)
        for place, (i, j) in enumerate(zip(*np.triu_indices(3), strict=True)):
            block[i, place] += dq[j]
            if i != j:
                block[j, place] += dq[i]
        block[:, 6:] = 1j * omega[line] * block[:, :6]
        rows.append(block)
        right.append(omega[line] ** 2 * M @ q[line])
    a, b = np.concatenate(rows), np.concatenate(right)
    a, b = np.concatenate([a.real, a.imag]), np.concatenate([b.real, b.imag])
    size = np.linalg.norm(a, axis=0)
    assert result.values == pytest.approx(np.linalg.lstsq(a / size, b, rcond=None)[0] / size, rel=1e-6)


def test_noise_of_pinv_is_that_of_its_derivatives_by_every_reading():
    """At exact motion an estimate moves in proportion to small noise: J C J^T, J by differences."""
    motion, _ = paper_motion(1e-3, None, 8)
    result = fit(motion, M, estimator="pinv")
    assert result.found.explained
    covariance = np.zeros((12, 12))
    for body, line in np.ndindex(2, 8):
        noise = motion.covariance[0, body, line].real
        steps = np.linalg.cholesky(noise).T * np.sqrt(0.5)  # independent errors of the real part, one a row
        for step in (*(1.0 + 0j) * steps, *1j * steps):
            q = motion.q.copy()
            q[0, body, line] += 1e-2 * step
            moved = 1e2 * (fit(replace(motion, q=q), M, estimator="pinv").values - result.values)
            covariance += np.outer(moved, moved)
    assert np.sqrt(np.diag(covariance)) == pytest.approx(result.noise_sd, rel=0.02)


def test_noise_of_the_regressor_biases_pinv_and_not_ml():
    errors, bias = {"pinv": [], "ml": []}, []
    size = entries.sizes(K, D)
    for seed in range(12):
        motion, _ = paper_motion(0.1, seed, 60)
        for name, found in errors.items():
            result = fit(motion, M, estimator=name)
            found.append((result.values - TRUTH) / size)
            if name == "pinv":
                bias.append(result.bias * entry_scale(result.found) / size)
    mean = {name: np.mean(found, axis=0) for name, found in errors.items()}
    assert np.abs(mean["pinv"]).max() > 3.0 * np.abs(mean["ml"]).max()
    large = np.abs(mean["pinv"]) > 0.03
    assert np.mean(bias, axis=0)[large] == pytest.approx(mean["pinv"][large], rel=0.4)
    assert "estimator_biased" in codes(fit(motion, M, estimator="pinv"))


def test_a_diagonal_entry_at_its_bound_zero_ends_in_a_page(tmp_path):
    motion, _ = paper_motion(0.6, 6, 20)
    result = fit(motion, M, estimator="constrained")
    assert result.damping[2, 2] == 0.0
    assert result.active == ("D33 at its bound",)
    assert np.isfinite(result.combinations[0][0])
    assert {"kd.json", "kd.html"} <= {path.name for path in result.write(tmp_path)}


def test_loud_lines_widen_the_intervals_of_pinv():
    off = []
    for seed in range(20):
        motion, _ = paper_motion(0.05, seed)
        exact, _ = paper_motion(0.05, None)
        loud = np.random.default_rng(seed).random(200) < 0.03
        q = np.where(loud[:, None], exact.q + 10.0 * (motion.q - exact.q), motion.q)
        off.append(deviation(fit(replace(motion, q=q), M, estimator="pinv")))
    assert np.mean(np.abs(off) < 1.96) > 0.85
    assert np.sqrt(np.mean(np.square(off))) < 1.5


@pytest.mark.parametrize(("law", "noise"), [("viscous", 0.6), ("hysteretic", 2.0)])
def test_constraints_hold_and_are_said(law, noise):
    held = 0
    for seed in range(6):
        motion, _ = paper_motion(noise, seed, 20, law)
        result = fit(motion, M, estimator="constrained", damping=law)
        held += bool(result.active)
        if law == "viscous":
            assert modes(M, result.stiffness, result.damping).max_real_1_s < 1e-3 * 2e4
        else:  # the eigenvalues of other laws have no state matrix: K and D are positive semidefinite
            assert passive(result.stiffness)
            assert passive(result.damping)
        assert "estimator_biased" in codes(result) or not result.active
    assert held


def test_bounds_are_kept():
    motion, _ = paper_motion(0.02, 2, 60)
    result = fit(motion, M, estimator="constrained", upper={"K11": 1500.0}, lower={"D11": 0.03})
    assert result.stiffness[0, 0] <= 1500.0 * (1.0 + 1e-3)
    assert result.damping[0, 0] >= 0.03 * (1.0 - 1e-3)
    assert any("K11" in word for word in result.active)


@pytest.mark.parametrize("estimator", ["pinv", "constrained"])
@pytest.mark.parametrize("law", ["hysteretic", "fractional"])
def test_textbooks_find_the_damping_law(estimator, law):
    motion, damping = paper_motion(0.005, 4, 100, law)
    result = fit(motion, M, estimator=estimator, damping="compare")
    assert result.law.name == law
    stated = fit(motion, M, estimator=estimator, damping=law)
    assert stated.values == pytest.approx(result.values, rel=1e-6)
    if law == "fractional":
        sd = np.sqrt(stated.found.covariance[12, 12])
        assert abs(stated.law.value - 0.7) < 3.0 * sd + 0.005  # the bias that noise of the regressor brings
    assert stated.damping[0, 0] == pytest.approx(damping[0, 0], abs=4.0 * stated.sd[6])
