"""The ring test on the page and in kd.json."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fitting.model.principal_axes import PRINCIPAL_DOF
from fitting.model.ring import RingTest, ring_test
from stapeskit.page import page

if TYPE_CHECKING:
    from markupsafe import Markup

    from fitting.kd_fit import KDFit

Array = NDArray[np.float64]


def ring_of(fit: KDFit, outline_mm: Array | None) -> RingTest | None:
    """Return the ring test of a fit; None for other degrees of freedom or without an outline."""
    if fit.dof != PRINCIPAL_DOF:
        return None
    middle = 2.0 * np.pi * float(np.sqrt(fit.observation.freq_hz.min() * fit.observation.freq_hz.max()))
    dynamic = fit.stiffness[0, 0] + complex(fit.law.factor(middle)) * fit.damping[0, 0]
    return ring_test(fit.stiffness, dynamic, outline_mm)


def ring_json(test: RingTest | None) -> dict[str, Any] | None:
    """Return the key ``ring`` of kd.json."""
    if test is None:
        return None
    return {
        "rim_length_mm": 1e3 * test.rim_length_m,
        "shear_modulus_times_thickness_over_width_pa": test.shear_pa,
        "loss_factor": test.loss_factor,
        "expected_stiffness_si": test.expected.stiffness.tolist(),
        "expected_origin_mm": [1e3 * test.expected.origin_x_m, 1e3 * test.expected.origin_z_m],
        "expected_angle_deg": float(np.degrees(test.expected.angle_rad)),
        "rocking_over_expected": list(test.rocking_ratio),
        "thickness_over_width_for_published_shear": list(test.thickness_over_width),
    }


def ring_parts(test: RingTest) -> tuple[Markup, ...]:
    """Return heading, words and table of the ring test."""
    measured, expected = test.measured, test.expected
    names = ("piston (N/m)", "about x′ (N m/rad)", "about z′ (N m/rad)")
    rows = [
        (name, f"{own:.4g}", f"{ring:.4g}", f"{own / ring:.3g}")
        for name, own, ring in zip(names, measured.stiffness, expected.stiffness, strict=True)
    ]
    for name, own, ring in (
        ("origin x (mm)", 1e3 * measured.origin_x_m, 1e3 * expected.origin_x_m),
        ("origin z (mm)", 1e3 * measured.origin_z_m, 1e3 * expected.origin_z_m),
        ("rotation (degrees)", np.degrees(measured.angle_rad), np.degrees(expected.angle_rad)),
    ):
        rows.append((name, f"{own:+.3f}", f"{ring:+.3f}", ""))
    low, high = test.thickness_over_width
    words = (
        f"A uniform ligament around the rim ({1e3 * test.rim_length_m:.2f} mm) with this piston stiffness "
        f"has a shear modulus times thickness over width of {1e-3 * test.shear_pa:.3g} kPa and a loss factor "
        f"of {test.loss_factor:.2g}; published shear moduli (5 to 70 kPa) ask for a thickness of {low:.2g} "
        f"to {high:.2g} widths. Its other stiffnesses follow from the outline alone; a ratio far from one "
        "means that the ligament is uneven around the rim, or that the model does not hold."
    )
    table = page.table(("", "measured", "uniform ring", "ratio"), rows)
    return page.subheading("Ring test"), page.text(words), table
