"""The ring test against closed forms of a circle and a rectangle, and against springs on the rim."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks.ring_ears import PIECES, PISTON, ring
from legacy.fitting.examples.paper import PAPER_STIFFNESS
from legacy.fitting.examples.paper_page import FOOTPLATE_MM
from legacy.fitting.fit_kd import fit_kd
from legacy.fitting.model.annular_ligament import Value, ellipse_mm, ring_stiffness, ring_test
from legacy.fitting.options import KDOptions
from legacy.fitting.recorded_fit import window_gap
from legacy.fitting.report.ring_section import ring_json, ring_of, ring_parts
from tests.fitting.cases import M, paper_motion


def test_a_circle_has_half_the_polar_moment_and_converges_with_the_square_of_the_step() -> None:
    exact = np.diag([2.0 * np.pi, np.pi, np.pi])
    errors = [np.abs(ring_stiffness(ellipse_mm(2.0, 2.0, n))[0] - exact).max() for n in (50, 100)]
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.05)


def test_a_rectangle_is_exact_wherever_it_lies() -> None:
    corners = np.array([[0.0, 0.0], [3.0, 0.0], [3.0, 1.0], [0.0, 1.0]])
    stiffness, length = ring_stiffness(corners)
    assert length == 8.0
    about_z = 2.0 * 3.0**3 / 3.0 + 1.0 * 3.0**2
    assert stiffness[2, 2] == pytest.approx(about_z, rel=1e-14)
    assert stiffness[0, 1] == pytest.approx(-0.5 * 8.0, rel=1e-14)
    assert stiffness[0, 2] == pytest.approx(1.5 * 8.0, rel=1e-14)


def test_it_is_a_ring_of_normal_springs_and_gives_back_its_stiffness_per_length() -> None:
    even = np.ones(PIECES), np.zeros(PIECES)
    springs = ring(0.0, 0.0, 2.0e5, np.zeros(3), np.zeros(3), even)[np.ix_(PISTON, PISTON)]
    test = ring_test(springs, (springs[0, 0], 0.3 * springs[0, 0]), 1j, ellipse_mm(2.8, 1.3))
    assert test is not None
    assert test.shear_pa.value == pytest.approx(2.0e5, rel=2e-3)
    assert test.rocking_ratio == pytest.approx((1.0, 1.0), abs=2e-3)
    assert test.loss_factor.value == pytest.approx(0.3)
    assert test.modulus_pa is None
    assert not np.isfinite(test.shear_pa.sd)


def test_the_paper_s_rocking_stiffness_exceeds_that_of_a_uniform_ring() -> None:
    test = ring_test(PAPER_STIFFNESS, (PAPER_STIFFNESS[0, 0], 0.0), 1j, ellipse_mm(*FOOTPLATE_MM))
    assert test is not None
    print(test.rocking_ratio)
    assert 2.0 < min(test.rocking_ratio) < max(test.rocking_ratio) < 3.5


def test_without_an_outline_there_is_none() -> None:
    assert ring_test(PAPER_STIFFNESS, (1.0, 0.0), 1j, None) is None


def thin_ring(modulus: float, loss: float, gap: float, thickness: float) -> tuple[float, float]:
    """Return K and loss K of a sheared annulus around a circle of radius 1 mm: 2 pi G t / ln(1 + g / r)."""
    stiffness = 2.0 * np.pi * modulus * thickness / np.log(1.0 + gap / 1e-3)
    return stiffness, loss * stiffness


def test_a_thin_annulus_gives_its_modulus_to_second_order_of_its_width() -> None:
    """ln(1 + g / r) = g / (r + g / 2) (1 + (g / r)^2 / 12 + ...)."""
    errors = []
    for gap in (4e-4, 2e-4):
        piston, lossy = thin_ring(2.0e4, 0.2, gap, 3e-4)
        stiffness = np.diag([piston, piston * 0.5e-6, piston * 0.5e-6])
        test = ring_test(stiffness, (piston, lossy), 1j, ellipse_mm(2.0, 2.0))
        test = replace(test, gap_m=Value(gap, 0.0), thickness_m=Value(3e-4, 0.0))
        errors.append(test.modulus_pa.value / 2.0e4 - 1.0)
        assert test.loss_factor.value == pytest.approx(0.2)
        assert test.rocking_ratio == pytest.approx((1.0, 1.0), abs=1e-4)
    assert abs(errors[0]) < 0.011
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.4)


def test_the_modulus_and_the_loss_factor_spread_as_stated() -> None:
    """2000 draws of K11, D11, width and thickness; a viscous law at 10^4 rad/s."""
    rng = np.random.default_rng(3)
    covariance = np.array([[40.0**2, 0.5 * 40.0 * 2e-3], [0.5 * 40.0 * 2e-3, 2e-3**2]])
    middle, factor, outline = np.array([1700.0, 0.05]), 1e4j, ellipse_mm(2.8, 1.3, 60)
    found = []
    for _ in range(2000):
        piston = rng.multivariate_normal(middle, covariance)
        stiffness = np.diag([piston[0], 1e-3, 3e-3])
        gap, thickness = (
            1e-4 * (1.0 + 0.05 * rng.standard_normal()),
            2.5e-4 * (1.0 + 0.04 * rng.standard_normal()),
        )
        test = ring_test(stiffness, piston, factor, outline, covariance)
        test = replace(test, gap_m=Value(gap, 5e-6), thickness_m=Value(thickness, 1e-5))
        found.append((test.modulus_pa.value, test.modulus_pa.sd, test.loss_factor.value, test.loss_factor.sd))
    modulus, modulus_sd, loss, loss_sd = np.array(found).T
    assert np.std(modulus) == pytest.approx(np.mean(modulus_sd), rel=0.06)
    assert np.std(loss) == pytest.approx(np.mean(loss_sd), rel=0.06)


def test_width_and_thickness_come_from_the_scan_or_from_the_options() -> None:
    record = SimpleNamespace(raw={"found": {"gap_mm": 0.12, "gap_sd_mm": 0.01}})
    fit = fit_kd(paper_motion(0.02, 0), M)
    outline = ellipse_mm(2.8, 1.3)
    seen = ring_json(ring_of(fit, outline, window_gap(record)))
    assert (seen["gap_mm"], seen["gap_sd_mm"]) == pytest.approx((0.12, 0.01))
    assert "shear_modulus_pa" not in seen
    options = KDOptions(ligament_gap_mm="0.1+-0.02", ligament_thickness_mm="0.25")
    test = ring_of(replace(fit, options=options), outline, window_gap(record))
    given = ring_json(test)
    middle = given["rim_length_mm"] + 0.1 * np.pi
    assert given["shear_modulus_pa"] == pytest.approx(1e6 * fit.stiffness[0, 0] * 0.1 / 0.25 / middle / 1e3)
    assert given["shear_modulus_sd_pa"] is None
    text = "".join(str(part) for part in ring_parts(test))
    assert "the shear modulus is" in text
    assert window_gap(None) is window_gap(SimpleNamespace(raw={"found": {"gap_mm": -1.0}})) is None
