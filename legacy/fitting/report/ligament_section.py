"""The section of the page about the plane of the ligament."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from legacy.fitting.kd_fit import KDFit
from legacy.fitting.law_fits import LawFit
from legacy.fitting.ligament.inplane_stiffness import INPLANE_DOF
from legacy.fitting.ligament.ligament_fit import LigamentFit
from legacy.fitting.model.parameter_vector import join, split
from legacy.stapeskit.page import page
from legacy.stapeskit.page.numbers import plus_minus
from legacy.stapeskit.page.page import Section
from legacy.stapeskit.page.quantities import diagonal_unit, matrix_units

if TYPE_CHECKING:
    from markupsafe import Markup


def ligament_section(fit: KDFit, ligament: LigamentFit) -> Section:
    """Return height and tilt of the plane, K and D about it, and what the plain model would have given."""
    height, height_sd = (1e3 * value for value in ligament.height)
    rows = [("height above the footplate centre (mm)", plus_minus(height, height_sd))]
    for name, value, sd in zip(("x", "z"), ligament.heights_m, ligament.heights_sd_m, strict=True):
        rows.append((f"height seen by rocking about {name} (mm)", plus_minus(1e3 * value, 1e3 * sd)))
    for name, (value, sd) in zip(("x", "z"), np.degrees(ligament.tilt_rad), strict=True):
        shown = plus_minus(value, sd) if np.isfinite(value) and sd < 45.0 else "undetermined"
        rows.append((f"tilt about {name} (degrees)", shown))
    stiffness_sd, damping_sd = split(np.sqrt(np.diag(ligament.plane_covariance)), len(fit.dof))
    section = Section("Plane of the ligament").add(
        page.text(
            "A ligament whose plane does not hold the footplate centre couples in-plane motion (x, z, beta) "
            "with piston and rocking. Its height and tilt are estimated with K and D, together with all "
            "shared errors of motion and mass."
        ),
        page.table(("", "value"), rows),
        page.quantity_matrix(
            ligament.plane_stiffness,
            matrix_units("K", fit.dof),
            fit.dof,
            "K about the plane of the ligament, ± sd.",
            stiffness_sd,
        ),
        page.quantity_matrix(
            ligament.plane_damping,
            matrix_units("D", fit.dof, fit.law.time_power),
            fit.dof,
            "D about the plane of the ligament, ± sd.",
            damping_sd,
        ),
    )
    inplane = [
        (f"stiffness {name}", diagonal_unit("K", name).with_sd(ligament.inplane.stiffness[place, place], sd))
        for place, (name, sd) in enumerate(
            zip(
                INPLANE_DOF,
                np.sqrt(np.diag(split(np.diag(ligament.inplane.covariance), len(INPLANE_DOF))[0])),
                strict=True,
            )
        )
    ]
    origin = "from the in-plane equations" if ligament.inplane.determined else "assumed: not determined"
    section.add(page.subheading(f"In the plane ({origin})"), page.table(("", "value"), inplane))
    if fit.plain is not None:
        section.add(page.subheading("Without in-plane motion"), _plain_table(fit, fit.plain))
    return section


def _plain_table(fit: KDFit, other: LawFit) -> Markup:
    """Return K and D next to those of the three degrees of freedom alone."""
    plain = other.estimate.parameters * other.problem.units
    values = join(fit.stiffness, fit.damping)
    sd = np.sqrt(np.diag(fit.covariance))
    rows = [
        (name, f"{value:.4g}", f"{alone:.4g}", f"{(alone - value) / spread:+.1f}")
        for name, value, alone, spread in zip(fit.parameters, values, plain, sd, strict=True)
    ]
    return page.table(("entry", "value (SI)", "three degrees of freedom alone", "difference in sd"), rows)
