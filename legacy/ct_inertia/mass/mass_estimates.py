"""Three ways to a mass (balance, calibrated grey values, density): which is used, how others differ."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from legacy.ct_inertia.calibrated import calibrated
from legacy.ct_inertia.errors import CtInertiaError
from legacy.ct_inertia.mass.mass_properties import MassProperties, from_density, from_mass
from legacy.ct_inertia.surface.moments import Moments
from legacy.stapeskit.option_names import named
from legacy.stapeskit.page.quantities import MASS, MILLIGRAM
from legacy.stapeskit.records.mass_record import MassMatrix
from legacy.stapeskit.warnings import Notice

if TYPE_CHECKING:
    from legacy.ct_inertia.bodies import Bodies
    from legacy.ct_inertia.mass.calibration import Calibration
    from legacy.ct_inertia.options import MassOptions


WORDS = {
    "mass": "the balance",
    "calibration": "calibrated grey values",
    "density": "the density given",
}
# Difference of two masses in its standard deviation from which they disagree: 3 of 1000 normal values.
_LIKELY_SDS = 3.0
_UNSTATED = calibrated("masses.unstated_share")
_NOT_STATED = {
    "density": "density_sd_not_given",
    "mass": "mass_sd_not_given",
    "calibration": "calibration_sd_not_given",
}


@dataclass(frozen=True)
class MassByWay:
    """The mass matrix by one of the ways to a mass.

    Attributes
    ----------
    way : str
        ``mass``, ``calibration`` or ``density``.
    body : MassProperties
        Added masses included.
    matrix : MassMatrix
        About the footplate centre in footplate axes.
    """

    way: str
    body: MassProperties
    matrix: MassMatrix

    def as_json(self, leading: MassMatrix) -> dict[str, Any]:
        """Return mass, implied density and the change of the mass matrix against the leading one."""
        centre = self.matrix.parameters[1:4] / self.matrix.parameters[0]
        usual = leading.parameters[1:4] / leading.parameters[0]
        root = np.sqrt(np.diag(leading.matrix))
        change = (self.matrix.matrix - leading.matrix) / np.outer(root, root)
        return {
            "by": self.way,
            "mass_kg": self.body.mass_kg,
            "mass_sd_kg": float(self.matrix.standard_deviation[0, 0]),
            "mass_sd_stated": self.way in self.matrix.contributions,
            "density_kg_m3": self.body.density_kg_m3,
            "mass_change_percent": 100.0 * (self.body.mass_kg / float(leading.parameters[0]) - 1.0),
            "center_of_mass_change_m": (centre - usual).tolist(),
            "matrix_si": self.matrix.matrix.tolist(),
            "matrix_change_percent": (100.0 * change).tolist(),
            "matrix_change_of": "sqrt(Mii Mjj) of the leading matrix",
        }


def masses_by_way(
    options: MassOptions,
    calibration: Calibration | None,
    bodies: Bodies | None,
    moments: Moments,
) -> dict[str, MassProperties]:
    """Return the mass properties of the bone by every way that was given, the leading one first.

    A measured mass leads, then a calibration, then a density: the balance sees the bone itself, the
    calibration its grey values, and a density is mostly another bone's.

    Parameters
    ----------
    options : MassOptions
    calibration : Calibration or None
    bodies : Bodies or None
        None for a mesh.
    moments : Moments
        Of the grey values, or of the closed surface where there are none.

    Raises
    ------
    CtInertiaError
        A density that no bone has, or a calibration without grey values.
    """
    masses: dict[str, MassProperties] = {}
    if options.mass_mg is not None:
        value, sd = options.mass_mg
        masses["mass"] = from_mass(moments, MILLIGRAM.si(value), None if sd is None else MILLIGRAM.si(sd))
    if options.calibration is not None:
        from legacy.ct_inertia.mass.calibration import from_calibration

        if bodies is None or bodies.levels is None or calibration is None:
            raise CtInertiaError.of(
                "{calibration}",
                "used with grey values",
                "labels alone",
                next_step="Give the scan as well, or {density}",
            )
        from legacy.ct_inertia.grey.bone_shape import shape_moments

        air, bone = bodies.levels.air, bodies.levels.bone
        shape = shape_moments(bodies, air, bone)
        masses["calibration"] = from_calibration(moments, shape, air, bone, calibration)
    if options.density is not None:
        masses["density"] = from_density(moments, *options.density)
    return masses


def at_uniform_density(body: MassProperties, moments: Moments) -> MassProperties:
    """Return the properties of another set of moments at the density of a body: a cross-check."""
    return from_density(replace(moments, contributions={}), body.density_kg_m3, None)


def disagreements(ways: Sequence[MassByWay]) -> list[Notice]:
    """Warn where two ways give masses further apart than their standard deviations explain.

    Where one of them has none, 5 % of the mass replace it.
    """
    if not ways:
        return []
    lead, *others = ways
    notices = []
    for other in others:
        stated = all(entry.way in entry.matrix.contributions for entry in (lead, other))
        sd = float(np.hypot(lead.matrix.standard_deviation[0, 0], other.matrix.standard_deviation[0, 0]))
        limit = _LIKELY_SDS * sd if stated else max(_LIKELY_SDS * sd, _UNSTATED * lead.body.mass_kg)
        apart = other.body.mass_kg - lead.body.mass_kg
        if abs(apart) > limit:
            percent = 100.0 * apart / lead.body.mass_kg
            notices.append(
                Notice(
                    "masses_disagree",
                    f"The mass by {WORDS[other.way]} is {MASS.text(apart, '+.3g')} ({percent:+.1f} %) off "
                    f"that by {WORDS[lead.way]}, which is used; their standard deviations explain "
                    f"{MASS.text(limit, '.2g')}. Check voxel size, density and balance.",
                )
            )
    return notices


def not_stated(contributions: Mapping[str, Any], way: str) -> list[Notice]:
    """Return the warning that the mass in use has no standard deviation."""
    if way in contributions:
        return []
    thing, option = {
        "density": ("the density", f"{named('density')} RHO+-SD"),
        "mass": ("the mass", f"{named('mass_mg')} M+-SD"),
        "calibration": ("the calibration", "sd_kg_m3 in its file"),
    }[way]
    text = f"No standard deviation of {thing} was given ({option}): {way} not included in the budget."
    return [Notice(_NOT_STATED[way], text)]
