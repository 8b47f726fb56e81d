"""Names of the quantities of laws for people, with units."""

from __future__ import annotations

from collections.abc import Sequence

from legacy.pipeline.cohort.cohort_laws import CohortLaw
from legacy.pipeline.cohort.compare_ears import Ear, damping_exponent
from legacy.stapeskit.page.quantities import (
    AREA,
    INERTIA,
    LENGTH,
    MASS,
    ROTATION_STIFFNESS,
    ShownUnit,
    diagonal_unit,
)

_UNITS = {
    "mass_kg": ("mass", MASS),
    "J1_kg_m2": ("J1", INERTIA),
    "J2_kg_m2": ("J2", INERTIA),
    "J3_kg_m2": ("J3", INERTIA),
    "footplate_area_m2": ("footplate area", AREA),
    "footplate_length_m": ("footplate length", LENGTH),
    "footplate_width_m": ("footplate width", LENGTH),
    "height_m": ("height", LENGTH),
    "gap_m": ("gap", LENGTH),
}
# Quantities for people: label, factor from SI.
SHOWN = {name: (f"{words} ({unit.symbol})", unit.per_si) for name, (words, unit) in _UNITS.items()}


def label(quantity: str) -> str:
    """Return the name of a quantity with its unit."""
    return SHOWN.get(quantity, (quantity, 1.0))[0]


def law_name(law: CohortLaw) -> str:
    """Return the name of a law: response ~ predictor."""
    return f"{law.response} ~ {label(law.predictor).partition(' (')[0]}"


def response_unit(response: str, ears: Sequence[Ear]) -> ShownUnit:
    """Return the unit in which a response of laws, such as ``K11``, is shown."""
    if response.startswith("K_principal"):
        return ROTATION_STIFFNESS
    dof = max((tuple(ear.kd["dof"]) for ear in ears), key=len)
    return diagonal_unit(response[0], dof[int(response[1]) - 1], damping_exponent(ears))
