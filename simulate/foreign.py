"""Stapes of many shape families as implicit bodies, independent of all phantoms used in development.

A body is a field in mm that is negative inside: rods along curves, a superelliptic footplate, a head; joined,
hollowed, and bent by a smooth random displacement of space. Body axes: x long axis of the footplate, y from
the footplate to the head, z across; the medial face lies about y = 0.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import numpy as np

from stapeskit.arrays import Array

_CHANGES: dict[str, dict[str, tuple[float, float]]] = {
    "base": {},
    "asymmetric": {"crus_posterior": (0.14, 0.14), "crus_anterior": (0.27, 0.27), "offset": (0.3, 0.3)},
    "thick": {"crus_posterior": (0.26, 0.30), "crus_anterior": (0.28, 0.33)},
    "thin": {"crus_posterior": (0.09, 0.11), "crus_anterior": (0.10, 0.13)},
    "gutter": {"crus_posterior": (0.24, 0.28), "crus_anterior": (0.26, 0.30)},
    "single": {},
    "hollow": {"thickness": (0.36, 0.42)},
    "perforated": {"hole": (0.10, 0.17)},
    "curved": {"curl": (0.12, 0.28)},
    "flat thin": {"thickness": (0.08, 0.12), "curl": (0.0, 0.0)},
    "filled": {},
    "focus": {},
}
FAMILIES = tuple(_CHANGES)


@dataclass(frozen=True, kw_only=True)
class Anatomy:
    """Sizes of one stapes, mm; ``bend`` (3, 3, 3, 3) are displacements at the nodes of a coarse lattice."""

    family: str = "base"
    length: float = 2.8
    width: float = 1.35
    thickness: float = 0.25
    curl: float = 0.0
    height: float = 3.3
    head_width: float = 0.5
    head_height: float = 0.4
    crus_posterior: float = 0.19
    crus_anterior: float = 0.22
    offset: float = 0.0
    hole: float = 0.0
    bend: Array = field(default_factory=lambda: np.zeros((3, 3, 3, 3)))


_USUAL = {
    "length": (2.55, 3.0), "width": (1.2, 1.5), "thickness": (0.2, 0.3), "curl": (0.0, 0.05),
    "height": (3.05, 3.5), "head_width": (0.45, 0.55), "head_height": (0.36, 0.45),
    "crus_posterior": (0.16, 0.21), "crus_anterior": (0.18, 0.24), "offset": (-0.12, 0.12),
}  # fmt: skip


def draw_anatomy(family: str, rng: np.random.Generator) -> Anatomy:
    """Draw a stapes of one of FAMILIES."""
    ranges = _USUAL | _CHANGES[family]
    drawn: dict[str, Any] = {name: float(rng.uniform(*ends)) for name, ends in ranges.items()}
    return replace(Anatomy(), family=family, bend=rng.normal(0.0, 0.05, (3, 3, 3, 3)), **drawn)


def anatomy_field(anatomy: Anatomy, points: Array) -> Array:
    """Return the field of a body at points (..., 3) in its axes; negative inside, about a distance in mm."""
    a = anatomy
    x, y, z = _bent(a, points)
    lift = a.curl * ((x / (0.5 * a.length)) ** 2 + 0.6 * (z / (0.5 * a.width)) ** 2)
    rim = _outline(a, x, z)
    plate = _filleted(np.abs(y - lift - 0.5 * a.thickness) - 0.5 * a.thickness, rim, np.maximum)
    if a.family == "hollow":
        middle = np.abs(y - lift - 0.5 * a.thickness) - (0.5 * a.thickness - 0.12)
        plate = np.maximum(plate, -np.maximum(middle, rim + 0.3))
    if a.hole:
        plate = np.maximum(plate, a.hole - np.hypot(x - 0.05, z))
    top, reach = a.height - a.head_height, 0.5 * a.length - 0.45
    legs = [
        _rod((x, y, z), *_nodes(a, side, top - 0.1, reach), radius)
        for side, radius in ((-1.0, a.crus_posterior), (1.0, a.crus_anterior))
    ]
    crura = legs[1] if a.family == "single" else np.minimum(*legs)
    if a.family == "gutter":
        crura = _hollowed(a, (x, y, z), crura, reach, top)
    head = _ellipsoid((x - a.offset, y - top, z), (a.head_width, a.head_height, 0.8 * a.head_width))
    solid = _filleted(_filleted(crura, plate, np.minimum), head, np.minimum)
    if a.family == "filled":
        half = reach * np.sqrt(np.clip(1.0 - (np.clip(y, 0.0, top) / top) ** 2, 0.0, 1.0))
        between = np.abs(x - a.offset * y / top) - half
        web = np.maximum(np.abs(z) - 0.07, np.abs(y - 1.2) - 0.7)
        solid = np.minimum(solid, np.maximum(web, between))
    if a.family == "focus":
        lump = _ellipsoid((x - reach - 0.2, y - 0.2, z), (0.35, 0.3, 0.3))
        solid = _filleted(solid, lump, np.minimum)
    return np.asarray(solid)


def _nodes(a: Anatomy, side: float, top: float, reach: float) -> tuple[Array, Array, Array]:
    """Return foot, knee and neck of a crus."""
    foot = np.array([side * reach, 0.7 * a.thickness + a.curl * 0.5, 0.0])
    knee = np.array([side * reach * 1.05, 0.6 * a.height, 0.0])
    return foot, knee, np.array([a.offset, top, 0.0])


def _outline(a: Anatomy, x: Array, z: Array) -> Array:
    """Return the approximate distance from a footplate's outline: a superellipse, one side flatter."""
    w = z + 0.12 * (1.0 - (x / (0.5 * a.length)) ** 2) * np.sign(a.offset + 1e-9)
    r = (np.abs(x / (0.5 * a.length)) ** 2.5 + np.abs(w / (0.5 * a.width)) ** 2.5) ** 0.4
    return np.asarray((r - 1.0) * 0.5 * a.width)


def _rod(p: tuple[Array, ...], start: Array, knee: Array, end: Array, radius: float) -> Array:
    """Return the distance from a rod along a quadratic curve: the least over short straight pieces."""
    t = np.linspace(0.0, 1.0, 9)[:, None]
    nodes = (1 - t) ** 2 * start + 2 * t * (1 - t) * knee + t**2 * end
    points = np.stack(p, axis=-1)
    least = np.full(points.shape[:-1], np.inf)
    for one, two in pairwise(nodes):
        along = two - one
        share = np.clip((points - one) @ along / (along @ along), 0.0, 1.0)
        np.minimum(least, np.linalg.norm(points - one - share[..., None] * along, axis=-1), out=least)
    return np.asarray(least - radius)


def _hollowed(a: Anatomy, p: tuple[Array, Array, Array], rods: Array, reach: float, top: float) -> Array:
    """Hollow both crura towards the opening between them: walls of about 100 um."""
    x, y, z = p
    shift = np.where(x < 0.3 * a.offset, 1.0, -1.0) * 0.14
    lumen = rods + 0.1
    for side, radius in ((-1.0, a.crus_posterior), (1.0, a.crus_anterior)):
        lumen = np.minimum(lumen, _rod((x - shift, y, z), *_nodes(a, side, top - 0.1, reach), radius - 0.08))
    lumen = np.maximum(lumen, np.maximum(a.thickness + 0.15 - y, y - top + 0.5))
    return np.asarray(np.maximum(rods, -lumen))


def _ellipsoid(p: tuple[Array, Array, Array], radii: tuple[float, float, float]) -> Array:
    r = np.sqrt(sum((part / radius) ** 2 for part, radius in zip(p, radii, strict=True)))
    return np.asarray((r - 1.0) * min(radii))


def _filleted(one: Array, two: Array, how: np.ufunc, rounding: float = 0.08) -> Array:
    """Join two bodies with a fillet (minimum), or cut one by the other with a rounded edge (maximum)."""
    near = np.clip(rounding - np.abs(one - two), 0.0, None)
    fillet = 0.25 * near * near / rounding
    return np.asarray(how(one, two) + (fillet if how is np.maximum else -fillet))


def _bent(a: Anatomy, points: Array) -> tuple[Array, Array, Array]:
    """Displace points (..., 3) by quadratic polynomials through the lattice over the body's box."""
    middle, size = np.array([0.0, 1.65, 0.0]), np.array([1.6, 1.75, 0.9])
    t = np.clip((points - middle) / size, -1.3, 1.3)
    bases = np.stack([0.5 * t * (t - 1.0), 1.0 - t * t, 0.5 * t * (t + 1.0)])
    moved = points + np.einsum(
        "i...,j...,k...,ijkd->...d", bases[..., 0], bases[..., 1], bases[..., 2], a.bend, optimize=True
    )
    return moved[..., 0], moved[..., 1], moved[..., 2]
