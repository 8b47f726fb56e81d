"""Names of the quantities of laws for people, with units."""

from __future__ import annotations

from pipeline.cohort.cohort_laws import CohortLaw

# Quantities for people: label, factor from SI.
SHOWN = {
    "mass_kg": ("mass (mg)", 1e6),
    "J1_kg_m2": ("J1 (mg mm²)", 1e12),
    "J2_kg_m2": ("J2 (mg mm²)", 1e12),
    "J3_kg_m2": ("J3 (mg mm²)", 1e12),
    "footplate_area_m2": ("footplate area (mm²)", 1e6),
    "footplate_length_m": ("footplate length (mm)", 1e3),
    "footplate_width_m": ("footplate width (mm)", 1e3),
    "height_m": ("height (mm)", 1e3),
    "gap_m": ("gap (mm)", 1e3),
}


def label(quantity: str) -> str:
    """Return the name of a quantity with its unit."""
    return SHOWN.get(quantity, (quantity, 1.0))[0]


def law_name(law: CohortLaw) -> str:
    """Return the name of a law: response ~ predictor."""
    return f"{law.response} ~ {label(law.predictor).partition(' (')[0]}"
