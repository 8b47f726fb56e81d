"""Published sizes and weights of human stapedes, and how far a measured one lies from them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from ct_inertia.frames.footplate import FootplateFrame
from ct_inertia.surface.repair import pieces
from ct_inertia.surface.surface import Surface, enclosed_moments
from ct_inertia.surface.winding import winding_number
from stapeskit.faults import StapeskitError
from stapeskit.report.quantities import MASS
from stapeskit.warnings import Notice

_OUTSIDE = 3.0  # z-score beyond which 3 of 1000 normal values lie
_RANGE_OF = {20: 3.735, 165: 5.31}
"""Expected range of n normal values in standard deviations (Tippett 1925, doi:10.1093/biomet/17.3-4.364)."""

_CALLIGAS = "Calligas and Todd 2018, Ear Nose Throat J 97:116 (micro-CT, mean and range)"
_GONG = "Gong et al. 2024, Folia Morphol 83:401, PMID 37622391 (micro-CT)"
_DASS = "Dass, Grewal and Thapar 1966 (mean and range)"
_IVANOVIC = "Ivanovic et al. 2024, doi:10.1038/s41598-024-69608-9 (synchrotron)"
_MODELS = "models of the middle ear, 1300 (doi:10.1007/s10237-016-0758-5) to 2200 kg/m3 (even distribution)"
_VINAYACHANDRA = "Vinayachandra et al. 2013, Medico-Legal Update 13(1):69 (mean)"


@dataclass(frozen=True)
class Published:
    """What one publication says of one quantity.

    Attributes
    ----------
    quantity : str
        Key of mass.json's ``found``, or ``volume_mm3``, ``mass_mg``, ``density_kg_m3``.
    sd : float or None
        None where it gives none.
    n : int
        Number of stapedes; 0 when not known here.
    """

    quantity: str
    mean: float
    sd: float | None
    n: int
    reference: str


def _by_range(quantity: str, mean: float, low: float, high: float, n: int, reference: str) -> Published:
    """Estimate the standard deviation from the range of n values."""
    return Published(quantity, mean, round((high - low) / _RANGE_OF[n], 3), n, reference)


def _by_weight(mass: Published, density: Published) -> Published:
    """Return the volumes that published weights have at published densities; the deviations are independent.

    Volumes themselves were published of a few stapedes only, whose spread is smaller than that of weights.
    """
    mean = 1e3 * mass.mean / density.mean
    sd = mean * float(np.hypot((mass.sd or 0.0) / mass.mean, (density.sd or 0.0) / density.mean))
    reference = f"weights of {mass.reference} over densities of {density.reference}"
    return Published("volume_mm3", round(mean, 2), round(sd, 2), mass.n, reference)


_WEIGHTS = _by_range("mass_mg", 3.02, 1.60, 5.45, 165, _DASS)
_DENSITIES = Published("density_kg_m3", 1750.0, 260.0, 0, _MODELS)

PUBLISHED = (
    Published("volume_mm3", 1.24, 0.29, 0, _IVANOVIC),
    _by_weight(_WEIGHTS, _DENSITIES),
    _WEIGHTS,
    Published("mass_mg", 2.08, None, 50, _VINAYACHANDRA),
    _DENSITIES,
    _by_range("height_mm", 3.43, 3.20, 3.80, 20, _CALLIGAS),
    _by_range("height_mm", 3.29, 2.80, 3.93, 165, _DASS),
    _by_range("footplate_length_mm", 2.71, 2.52, 2.97, 20, _CALLIGAS),
    Published("footplate_length_mm", 2.93, 0.17, 30, _GONG),
    _by_range("footplate_width_mm", 1.23, 1.12, 1.46, 20, _CALLIGAS),
    Published("footplate_width_mm", 1.46, 0.08, 30, _GONG),
)

NAMES = {
    "volume_mm3": ("volume", "mm³"),
    "mass_mg": ("mass", "mg"),
    "density_kg_m3": ("density", "kg/m³"),
    "height_mm": ("height", "mm"),
    "footplate_length_mm": ("footplate length", "mm"),
    "footplate_width_mm": ("footplate width", "mm"),
}
"""Name and unit of each quantity."""

POSSIBLE = {
    "height_mm": (2.4, 5.0),
    "footplate_length_mm": (1.8, 4.0),
    "footplate_width_mm": (0.7, 2.2),
    "volume_mm3": (0.3, 6.0),
}
"""Sizes that a human stapes can have: far wider than real ones."""

_BODY_MM, _TYPICAL_MM = (1.0, 12.0), 3.5  # longest extent of a named body in mm, and the usual one
_UNITS = {"metres": 1e3, "centimetres": 10.0, "inches": 25.4, "micrometres": 1e-3, "nanometres": 1e-6}
_LEAST_BODY = 1e-6  # of the largest body of a mesh: a smaller one is a speck of rounding


def measured_sizes(volume_m3: float, density_kg_m3: float, footplate: FootplateFrame) -> dict[str, float]:
    """Return the quantities to compare, of the bone without what was glued to it."""
    return {
        "volume_mm3": volume_m3 * 1e9,
        "mass_mg": MASS.of(volume_m3 * density_kg_m3),
        "density_kg_m3": density_kg_m3,
        "height_mm": footplate.height_mm,
        "footplate_length_mm": footplate.length_mm,
        "footplate_width_mm": footplate.width_mm,
    }


def comparisons(sizes: Mapping[str, float]) -> list[dict[str, Any]]:
    """Return every publication of the quantities measured, with value and z-score."""
    return [
        {**asdict(entry), "value": sizes[entry.quantity], "z": _z(entry, sizes[entry.quantity])}
        for entry in PUBLISHED
        if entry.quantity in sizes
    ]


def _z(entry: Published, value: float) -> float | None:
    return None if entry.sd is None else (value - entry.mean) / entry.sd


def unusual_notice(sizes: Mapping[str, float]) -> list[Notice]:
    """Warn of quantities that lie more than 3 standard deviations from every publication."""
    unusual = []
    for quantity, value in sizes.items():
        scores = [(z, entry) for entry in PUBLISHED if entry.quantity == quantity and (z := _z(entry, value))]
        if not scores:
            continue
        z, nearest = min(scores, key=lambda one: abs(one[0]))
        if abs(z) > _OUTSIDE:
            name, unit = NAMES[quantity]
            unusual.append(
                f"{name} {value:.3g} {unit} (published {nearest.mean:g} ± {nearest.sd:g}, z {z:+.1f}; "
                f"{nearest.reference})"
            )
    if not unusual:
        return []
    text = (
        f"Outside of what is published of human stapedes: {'; '.join(unusual)}. Check the voxel spacing (1 % "
        "of it is 3 % of the volume), the density, and in the report what was measured."
    )
    return [Notice("outside_published_sizes", text)]


def impossible(sizes: Mapping[str, float]) -> list[str]:
    """Return every size that no human stapes has, with what it could be; empty when all can be."""
    return [
        f"a {NAMES[key][0]} of {sizes[key]:.3g} {NAMES[key][1]} ({low:g} to {high:g} is possible)"
        for key, (low, high) in POSSIBLE.items()
        if not low <= sizes[key] <= high
    ]


def unsuitable(reasons: Sequence[str], notices: Sequence[Notice]) -> StapeskitError:
    """Return the error for a body that cannot be a stapes, with the warnings about the scan's border."""
    step = (
        "Name the stapes with --seed X,Y,Z (a point inside it, scan mm) or --labels, leave other bone out "
        "with --box or --threshold, and check the voxel spacing"
    )
    border = [notice.text for notice in notices if notice.code == "touches_border"]
    got = f"no object that can be a stapes: the likeliest has {', '.join(reasons)}"
    expected = "one with a body that can be a stapes"
    return StapeskitError.of("the scan", expected, got, next_step=". ".join([step, *border]))


def check_mesh(mesh: Surface, name: str) -> None:
    """Refuse a mesh of several bodies, and one that is written in another unit than mm.

    Raises
    ------
    StapeskitError
        More than one piece encloses a volume (a cavity in the largest does not), or the longest extent is
        below 1 or above 12 mm.
    """
    parts = pieces(mesh.faces)
    volumes = np.array([enclosed_moments(mesh.vertices_mm, mesh.faces[part])[0] for part in parts])
    largest = mesh.faces[parts[int(np.argmax(volumes))]]
    of_each = mesh.vertices_mm[mesh.faces[[part[0] for part in parts], 0]]
    cavity = (volumes < 0.0) & (winding_number(mesh.vertices_mm, largest, of_each) > 0.5)
    sizes = np.abs(volumes[~cavity])
    bodies = sorted(sizes[sizes > _LEAST_BODY * sizes.max()], reverse=True)
    if len(bodies) > 1:
        listed = ", ".join(f"{volume:.3g}" for volume in bodies[:4])
        got = f"{len(bodies)} bodies (of {listed}{' ...' if len(bodies) > 4 else ''} mm3)"
        step = "Remove the others, or join them into one closed body, and export it again"
        raise StapeskitError.of("the mesh", "one closed body, the stapes", got, name, step)
    check_unit(float(np.max(np.ptp(mesh.vertices_mm, axis=0))), "the mesh", name)


def check_unit(size_mm: float, thing: str, name: str) -> None:
    """Refuse a named body whose longest extent shows another unit, or voxel spacing, than mm.

    Raises
    ------
    StapeskitError
        It is below 1 or above 12 mm.
    """
    if _BODY_MM[0] <= size_mm <= _BODY_MM[1]:
        return
    unit, factor = min(_UNITS.items(), key=lambda entry: abs(np.log(size_mm * entry[1] / _TYPICAL_MM)))
    known = 0.5 < size_mm * factor / _TYPICAL_MM < 2.0
    probable = f"it is probably in {unit}" if known else "its unit may be that of the voxels"
    step = (
        f"Export it in mm (multiply it by {factor:g})"
        if known
        else "Export it in mm, or correct the voxel spacing"
    )
    got = f"{size_mm:.3g} mm; {probable}"
    raise StapeskitError.of(thing, "in mm: a stapes is 3 to 4 mm long", got, name, step)
