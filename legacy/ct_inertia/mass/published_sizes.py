"""Published sizes and weights of human stapedes, and how far a measured one lies from them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from legacy.stapeskit.page.quantities import MASS, MILLIGRAM
from legacy.stapeskit.warnings import Notice

if TYPE_CHECKING:
    from legacy.ct_inertia.frames.footplate import FootplateFrame

CODE = "outside_published_sizes"
# Beyond this z-score of every publication, which 3 of 1000 normal values are, a notice is given.
_OUTSIDE = 3.0
# Expected range of n normal values in standard deviations (Tippett 1925, doi:10.1093/biomet/17.3-4.364).
_RANGE_OF = {20: 3.735, 165: 5.31}

_CALLIGAS = "Calligas and Todd 2018, Ear Nose Throat J 97:116 (micro-CT, mean and range)"
_GONG = "Gong et al. 2024, Folia Morphol 83:401, PMID 37622391 (micro-CT)"
_DASS = "Dass, Grewal and Thapar 1966 (mean and range)"
_IVANOVIC = "Ivanovic et al. 2024, doi:10.1038/s41598-024-69608-9 (synchrotron)"
_MODELS = "models of the middle ear, 1300 (doi:10.1007/s10237-016-0758-5) to 2200 kg/m3 (even distribution)"
_VINAYACHANDRA = "Vinayachandra et al. 2013, Medico-Legal Update 13(1):69 (mean)"


@dataclass(frozen=True)
class Published:
    """What one publication says of one quantity; ``sd`` is None where it gives none.

    Attributes
    ----------
    quantity : str
        Key of mass.json's ``found``, or ``volume_mm3``, ``mass_mg``.
    mean : float
    sd : float or None
    n : int
        Number of stapedes; 0 when not known here.
    reference : str
    """

    quantity: str
    mean: float
    sd: float | None
    n: int
    reference: str


def _by_range(quantity: str, mean: float, low: float, high: float, n: int, reference: str) -> Published:
    """Estimate the standard deviation from the range of n values."""
    return Published(quantity, mean, round((high - low) / _RANGE_OF[n], 3), n, reference)


# Means, standard deviations or ranges, and numbers of stapedes, each with its reference.
PUBLISHED = (
    Published("volume_mm3", 1.24, 0.29, 0, _IVANOVIC),
    _by_range("mass_mg", 3.02, 1.60, 5.45, 165, _DASS),
    Published("mass_mg", 2.08, None, 50, _VINAYACHANDRA),
    Published("density_kg_m3", 1750.0, 260.0, 0, _MODELS),
    _by_range("height_mm", 3.43, 3.20, 3.80, 20, _CALLIGAS),
    _by_range("height_mm", 3.29, 2.80, 3.93, 165, _DASS),
    _by_range("footplate_length_mm", 2.71, 2.52, 2.97, 20, _CALLIGAS),
    Published("footplate_length_mm", 2.93, 0.17, 30, _GONG),
    _by_range("footplate_width_mm", 1.23, 1.12, 1.46, 20, _CALLIGAS),
    Published("footplate_width_mm", 1.46, 0.08, 30, _GONG),
)
NAMES = {
    "volume_mm3": ("volume", "mm3"),
    "mass_mg": ("mass", MASS.symbol),
    "density_kg_m3": ("density", "kg/m3"),
    "height_mm": ("height", "mm"),
    "footplate_length_mm": ("footplate length", "mm"),
    "footplate_width_mm": ("footplate width", "mm"),
}


def shown(quantity: str, value: float) -> float:
    """Return a value of a quantity in the unit of `NAMES`."""
    return MASS.of(MILLIGRAM.si(value)) if quantity == "mass_mg" else value


def comparisons(values: Mapping[str, float]) -> list[dict[str, Any]]:
    """Return every publication of the quantities measured, with value and z-score.

    Parameters
    ----------
    values : mapping of str to float
        By the names of `PUBLISHED`.
    """
    return [
        {**asdict(entry), "value": values[entry.quantity], "z": _z(entry, values[entry.quantity])}
        for entry in PUBLISHED
        if entry.quantity in values
    ]


def _z(entry: Published, value: float) -> float | None:
    return None if entry.sd is None else (value - entry.mean) / entry.sd


def unusual_notice(values: Mapping[str, float]) -> list[Notice]:
    """Warn of quantities that lie more than 3 standard deviations from every publication."""
    unusual = []
    for quantity, value in values.items():
        of = [
            (abs(z), published)
            for published in PUBLISHED
            if published.quantity == quantity and (z := _z(published, value))
        ]
        if of and min(z for z, _ in of) > _OUTSIDE:
            z, nearest = min(of, key=lambda entry: entry[0])
            name, unit = NAMES[quantity]
            signed = np.copysign(z, value - nearest.mean)
            here, mean, sd = (shown(quantity, number or 0.0) for number in (value, nearest.mean, nearest.sd))
            unusual.append(
                f"{name} {here:.3g} {unit} (published {mean:g} +- {sd:g}, z {signed:+.1f}; "
                f"{nearest.reference})"
            )
    if not unusual:
        return []
    text = (
        f"Outside of what is published of human stapedes: {'; '.join(unusual)}. Check the voxel spacing "
        f"(1 % of it is 3 % of the volume), the density, and in the report what was measured."
    )
    return [Notice(CODE, text)]


def measured_values(volume_m3: float, density_kg_m3: float, footplate: FootplateFrame) -> dict[str, float]:
    """Return the quantities to compare, of the bone without what was glued to it."""
    return {
        "volume_mm3": volume_m3 * 1e9,
        "mass_mg": MILLIGRAM.of(volume_m3 * density_kg_m3),
        "density_kg_m3": density_kg_m3,
        "height_mm": footplate.height_mm,
        "footplate_length_mm": footplate.length_mm,
        "footplate_width_mm": footplate.width_mm,
    }
