"""The ring test on the page and in kd.json."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from legacy.fitting.model.annular_ligament import RingTest, Value, ring_test
from legacy.fitting.model.principal_axes import PRINCIPAL_DOF
from legacy.stapeskit.arrays import Array, finite_or_none
from legacy.stapeskit.page import page
from legacy.stapeskit.page.numbers import plus_minus
from legacy.stapeskit.page.quantities import ROTATION_STIFFNESS, STIFFNESS

if TYPE_CHECKING:
    from markupsafe import Markup

    from legacy.fitting.kd_fit import KDFit
    from legacy.stapeskit.option_values import WithSd


def ring_of(fit: KDFit, outline_mm: Array | None, gap_mm: WithSd | None = None) -> RingTest | None:
    """Return the ring test of a fit; None for other degrees of freedom or without an outline.

    ``gap_mm`` is what the scan shows; a width among the options of the fit comes first.
    """
    if fit.dof != PRINCIPAL_DOF:
        return None
    middle = 2.0 * np.pi * float(np.sqrt(fit.observation.freq_hz.min() * fit.observation.freq_hz.max()))
    places = [fit.parameters.index(name) for name in ("K11", "D11")]
    piston = (fit.stiffness[0, 0], fit.damping[0, 0])
    factor = complex(fit.law.factor(middle))
    covariance = fit.covariance[np.ix_(places, places)]
    test = ring_test(fit.stiffness, piston, factor, outline_mm, covariance)
    if test is None:
        return None
    gap, thickness = fit.options.ligament_gap_mm or gap_mm, fit.options.ligament_thickness_mm
    return replace(test, gap_m=_length(gap), thickness_m=_length(thickness))


def _length(stated_mm: WithSd | None) -> Value | None:
    """Return a length that was given in mm, in m; its standard deviation is NaN where none is given."""
    if stated_mm is None:
        return None
    value, sd = stated_mm
    return Value(1e-3 * value, np.nan if sd is None else 1e-3 * sd)


def ring_json(test: RingTest | None) -> dict[str, Any] | None:
    """Return the key ``ring`` of kd.json."""
    if test is None:
        return None
    shear, loss = test.shear_pa, test.loss_factor
    return {
        "rim_length_mm": 1e3 * test.rim_length_m,
        "shear_modulus_times_thickness_over_width_pa": shear.value,
        "shear_modulus_times_thickness_over_width_sd_pa": finite_or_none(shear.sd),
        "loss_factor": loss.value,
        "loss_factor_sd": finite_or_none(loss.sd),
        "expected_stiffness_si": test.expected.stiffness.tolist(),
        "expected_origin_mm": [1e3 * test.expected.origin_x_m, 1e3 * test.expected.origin_z_m],
        "expected_angle_deg": float(np.degrees(test.expected.angle_rad)),
        "rocking_over_expected": list(test.rocking_ratio),
        "thickness_over_width_for_published_shear": list(test.thickness_over_width),
        **_number_keys("gap", "mm", test.gap_m, 1e3),
        **_number_keys("shear_modulus_times_thickness", "pa_m", test.shear_times_thickness, 1.0),
        **_number_keys("thickness", "mm", test.thickness_m, 1e3),
        **_number_keys("shear_modulus", "pa", test.modulus_pa, 1.0),
    }


def _number_keys(name: str, unit: str, number: Value | None, factor: float) -> dict[str, float | None]:
    """Return the keys of a number and its standard deviation; none where it is not known."""
    if number is None:
        return {}
    return {f"{name}_{unit}": factor * number.value, f"{name}_sd_{unit}": finite_or_none(factor * number.sd)}


def ring_parts(test: RingTest) -> tuple[Markup, ...]:
    """Return heading, words and table of the ring test."""
    measured, expected = test.measured, test.expected
    names = ("piston", "about x′", "about z′")
    units = (STIFFNESS, ROTATION_STIFFNESS, ROTATION_STIFFNESS)
    rows = [
        (f"{name} ({unit.symbol})", f"{unit.of(own):.4g}", f"{unit.of(ring):.4g}", f"{own / ring:.3g}")
        for name, unit, own, ring in zip(names, units, measured.stiffness, expected.stiffness, strict=True)
    ]
    for name, own, ring in (
        ("origin x (mm)", 1e3 * measured.origin_x_m, 1e3 * expected.origin_x_m),
        ("origin z (mm)", 1e3 * measured.origin_z_m, 1e3 * expected.origin_z_m),
        ("rotation (degrees)", np.degrees(measured.angle_rad), np.degrees(expected.angle_rad)),
    ):
        rows.append((name, f"{own:+.3f}", f"{ring:+.3f}", ""))
    words = (
        f"A uniform ligament around the rim ({1e3 * test.rim_length_m:.2f} mm) with this piston stiffness "
        f"has a shear modulus times thickness over width of {_text(test.shear_pa, 1e-3)} kPa and a loss "
        f"factor of {_text(test.loss_factor)}. {_modulus(test)} Its other stiffnesses follow from the "
        "outline alone; a ratio far from one means that the ligament is uneven around the rim, or that the "
        "model does not hold."
    )
    table = page.table(("", "measured", "uniform ring", "ratio"), rows)
    return page.subheading("Ring test"), page.text(words), table


def _modulus(test: RingTest) -> str:
    """Return what follows for the shear modulus, or the thickness that published moduli ask for."""
    if test.modulus_pa is not None and test.gap_m is not None and test.thickness_m is not None:
        return (
            f"With a width of {_text(test.gap_m, 1e3)} mm and a thickness of "
            f"{_text(test.thickness_m, 1e3)} mm the shear modulus is {_text(test.modulus_pa, 1e-3)} kPa "
            "(published: 5 to 70 kPa)."
        )
    wanted = "Published shear moduli (5 to 70 kPa) ask for a thickness of"
    if test.gap_m is not None and test.thickness_for_published_m is not None:
        low, high = (1e3 * value for value in test.thickness_for_published_m)
        return f"{wanted} {low:.2g} to {high:.2g} mm at a width of {_text(test.gap_m, 1e3)} mm."
    low, high = test.thickness_over_width
    return f"{wanted} {low:.2g} to {high:.2g} widths."


def _text(number: Value, factor: float = 1.0) -> str:
    """Return a number with its standard deviation where that is known."""
    value, sd = factor * number.value, factor * number.sd
    return plus_minus(value, sd) if sd > 0.0 else f"{value:.3g}"
