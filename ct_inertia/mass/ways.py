"""The ways to a mass (balance, calibrated grey values, stated or assumed density), and their comparison."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ct_inertia.bodies import MeasuredBody, Moments
from ct_inertia.mass.calibration import Calibration, from_calibration
from ct_inertia.mass.properties import MassProperties, from_density, from_mass
from ct_inertia.options import ASSUMED_DENSITY
from stapeskit.faults import StapeskitError
from stapeskit.option_types import WithSd
from stapeskit.records.mass_matrix import MassMatrix
from stapeskit.report.quantities import MASS
from stapeskit.warnings import Notice

_LIKELY_SDS = 3.0  # 3 of 1000 normal values are further apart
_UNSTATED_SHARE = 0.05  # of the mass: replaces a standard deviation that was not given, in comparisons only


@dataclass(frozen=True)
class Way:
    """A way to a mass.

    Attributes
    ----------
    words : str
        What the mass comes from.
    what, how : str
        What the warning of a missing standard deviation names, and how it is given.
    """

    words: str
    what: str
    how: str


WAYS = {
    "mass": Way("the balance", "the mass", "--mass-mg M+-SD"),
    "calibration": Way("calibrated grey values", "the calibration", "sd_kg_m3 in its file"),
    "density": Way("the density", "the density", "--density RHO+-SD"),
}
"""In the order in which they lead: the balance sees the bone itself, the calibration its grey values, and a
density is mostly another bone's. The names are those of their sources in the budget."""


@dataclass(frozen=True)
class MassByWay:
    """The mass by one of the ways; added masses included.

    Attributes
    ----------
    way : str
        One of `WAYS`.
    matrix : MassMatrix
        About the footplate centre in footplate axes.
    """

    way: str
    body: MassProperties
    matrix: MassMatrix

    @property
    def stated(self) -> bool:
        """Whether the mass has a standard deviation of its density, calibration or balance."""
        return self.way in self.matrix.contributions

    def as_json(self, leading: MassMatrix) -> dict[str, Any]:
        """Return mass, implied density and the change of the mass against the leading one."""
        return {
            "by": self.way,
            "mass_kg": self.body.mass_kg,
            "mass_sd_kg": float(self.matrix.standard_deviation[0, 0]) if self.stated else None,
            "density_kg_m3": self.body.density_kg_m3,
            "mass_change_percent": 100.0 * (self.body.mass_kg / float(leading.parameters[0]) - 1.0),
        }


def masses_by_way(
    moments: Moments,
    density: WithSd | None,
    mass_mg: WithSd | None,
    calibration: Calibration | None,
    measured: MeasuredBody | None,
) -> dict[str, MassProperties]:
    """Return the mass properties of the bone by every way that was given, the leading one first.

    Densities in kg/m3, masses in mg; where nothing is given a density is assumed. ``measured`` has the grey
    values that a calibration needs.

    Raises
    ------
    StapeskitError
        A density by mass or calibration that no bone has, or a calibration without grey values.
    """
    masses: dict[str, MassProperties] = {}
    if mass_mg is not None:
        sd = None if mass_mg.sd is None else MASS.si(mass_mg.sd)
        masses["mass"] = from_mass(moments, MASS.si(mass_mg.value), sd)
    if calibration is not None:
        if measured is None or measured.scene is None:
            step = "Give the scan as well, or --density"
            raise StapeskitError.of("--calibration", "used with grey values", "none", next_step=step)
        scene = measured.scene
        masses["calibration"] = from_calibration(
            measured.moments, scene.even, scene.air, scene.bone, calibration
        )
    if density is None and not masses:
        density = ASSUMED_DENSITY
    if density is not None:
        masses["density"] = from_density(moments, density.value, density.sd)
    return masses


def assumed_notice() -> Notice:
    """Return the warning that the density was assumed, with what it moves and how to state one's own."""
    value, sd = ASSUMED_DENSITY.value, ASSUMED_DENSITY.sd
    text = (
        f"Nothing says what the stapes weighs: a density of bone of {value:g} ± {sd:g} kg/m3 is assumed, and "
        "its standard deviation is in every interval. M, K and D scale with it, frequencies and mode shapes "
        "do not. State your own with --mass-mg M+-SD (a balance), --calibration FILE.toml or --density "
        "RHO+-SD."
    )
    return Notice("density_assumed", text)


def not_stated(way: MassByWay) -> list[Notice]:
    """Return the warning that the mass in use has no standard deviation."""
    if way.stated:
        return []
    entry = WAYS[way.way]
    text = f"No sd of {entry.what} was given ({entry.how}): {way.way} not included in the budget."
    return [Notice("density_sd_not_given", text)]


def disagreements(ways: Sequence[MassByWay]) -> list[Notice]:
    """Warn where two ways give masses further apart than their standard deviations explain.

    Where one of them has none, 5 % of the mass replace it.
    """
    lead, *others = ways
    notices = []
    for other in others:
        sd = float(np.hypot(lead.matrix.standard_deviation[0, 0], other.matrix.standard_deviation[0, 0]))
        limit = _LIKELY_SDS * sd
        if not (lead.stated and other.stated):
            limit = max(limit, _UNSTATED_SHARE * lead.body.mass_kg)
        apart = other.body.mass_kg - lead.body.mass_kg
        if abs(apart) > limit:
            percent = 100.0 * apart / lead.body.mass_kg
            text = (
                f"The mass by {WAYS[other.way].words} is {MASS.text(apart, '+.3g')} ({percent:+.1f} %) off "
                f"that by {WAYS[lead.way].words}, which is used; their standard deviations explain "
                f"{MASS.text(limit, '.2g')}. Check voxel size, density and balance."
            )
            notices.append(Notice("masses_disagree", text))
    return notices
