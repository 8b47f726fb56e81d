"""Stapedes of many families as implicit bodies, made apart from the phantoms that ct2mass was developed on.

A body is a field in mm that is negative inside: rods along curves, a superelliptic footplate, a head; joined,
hollowed, and bent by a smooth random displacement of space. Body axes: x long axis of the footplate, y from
the footplate to the head, z across; the medial face lies about y = 0.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Field = NDArray[np.float32]

FAMILIES = (
    "base", "asymmetric", "thick", "thin", "gutter", "single", "hollow", "perforated", "curved",
    "flat thin", "filled", "focus", "mirrored",
)  # fmt: skip


@dataclass(frozen=True)
class Anatomy:
    """Sizes of one stapes, mm; ``bend`` (3, 3, 3, 3) are displacements at the corners of a coarse lattice."""

    family: str
    length: float = 2.8
    width: float = 1.35
    thickness: float = 0.25
    curl: float = 0.0
    height: float = 3.3
    head: tuple[float, float] = (0.52, 0.42)
    crus: tuple[float, float] = (0.19, 0.22)
    offset: float = 0.0
    holes: tuple[tuple[float, float, float], ...] = ()
    scale: float = 1.0
    mirror: bool = False
    bend: Array = field(default_factory=lambda: np.zeros((3, 3, 3, 3)))


def draw(family: str, rng: np.random.Generator) -> Anatomy:
    """Draw a stapes of one family."""
    some = Anatomy(
        family,
        length=rng.uniform(2.55, 3.0),
        width=rng.uniform(1.2, 1.5),
        thickness=rng.uniform(0.2, 0.3),
        curl=rng.uniform(0.0, 0.05),
        height=rng.uniform(3.05, 3.5),
        head=(rng.uniform(0.45, 0.55), rng.uniform(0.36, 0.45)),
        crus=(rng.uniform(0.16, 0.21), rng.uniform(0.18, 0.24)),
        offset=rng.uniform(-0.12, 0.12),
        scale=rng.uniform(0.95, 1.05),
        bend=rng.normal(0.0, 0.05, (3, 3, 3, 3)),
    )
    changes: dict[str, dict[str, Any]] = {
        "asymmetric": {"offset": rng.choice((-0.3, 0.3)), "crus": (0.14, 0.27)},
        "thick": {"crus": (rng.uniform(0.26, 0.3), rng.uniform(0.28, 0.33))},
        "thin": {"crus": (rng.uniform(0.09, 0.11), rng.uniform(0.1, 0.13))},
        "gutter": {"crus": (rng.uniform(0.24, 0.28), rng.uniform(0.26, 0.3))},
        "hollow": {"thickness": rng.uniform(0.36, 0.42)},
        "perforated": {"holes": ((rng.uniform(-0.2, 0.3), rng.uniform(-0.1, 0.1), rng.uniform(0.1, 0.17)),)},
        "curved": {"curl": rng.uniform(0.12, 0.28)},
        "flat thin": {"thickness": rng.uniform(0.08, 0.12), "curl": 0.0},
        "mirrored": {"mirror": True},
    }
    return replace(some, **changes.get(family, {}))


def body(anatomy: Anatomy, points: tuple[Field, Field, Field]) -> Field:
    """Return the field of a body at points x, y, z in its axes; negative inside, in about mm."""
    x, y, z = _bend(anatomy, tuple(p / np.float32(anatomy.scale) for p in points))
    if anatomy.mirror:
        x = -x
    a = anatomy
    lift = a.curl * ((x / (0.5 * a.length)) ** 2 + 0.6 * (z / (0.5 * a.width)) ** 2)
    rim = _outline(a, x, z)
    plate = _join(np.abs(y - lift - 0.5 * a.thickness) - 0.5 * a.thickness, rim, np.maximum)
    if a.family == "hollow":
        middle = np.abs(y - lift - 0.5 * a.thickness) - (0.5 * a.thickness - 0.12)
        plate = np.maximum(plate, -np.maximum(middle, rim + 0.3))
    for u, w, radius in a.holes:
        plate = np.maximum(plate, radius - np.hypot(x - u, z - w))
    top = a.height - a.head[1]
    reach = 0.5 * a.length - 0.45
    legs = []
    for side, radius in zip((-1.0, 1.0), a.crus, strict=True):
        foot = np.array([side * reach, 0.7 * a.thickness + a.curl * 0.5, 0.0])
        neck = np.array([a.offset, top - 0.1, 0.0])
        knee = np.array([side * reach * 1.05, 0.6 * a.height, 0.0])
        legs.append(_rod((x, y, z), foot, knee, neck, radius))
    if a.family == "single":
        legs = legs[1:]
    ossicle = legs[0] if len(legs) == 1 else np.minimum(legs[0], legs[1])
    if a.family == "gutter":
        ossicle = _gutter(a, (x, y, z), ossicle, reach, top)
    head = _ellipsoid((x - a.offset, y - top, z), (a.head[0], a.head[1], 0.8 * a.head[0]))
    solid = _join(_join(ossicle, plate, np.minimum), head, np.minimum)
    if a.family == "filled":
        web = np.maximum(
            np.abs(z) - 0.07, np.maximum(np.abs(x - 0.3 * a.offset) - reach, np.abs(y - 1.2) - 0.7)
        )
        solid = np.minimum(solid, np.maximum(web, _between(a, x, y, reach, top)))
    if a.family == "focus":
        solid = _join(solid, _ellipsoid((x - reach - 0.2, y - 0.2, z), (0.35, 0.3, 0.3)), np.minimum)
    return np.asarray(solid * np.float32(a.scale), dtype=np.float32)


def window(anatomy: Anatomy, points: tuple[Field, Field, Field], gap_mm: float) -> Field:
    """Return the field of the bone around the oval window: a slab with the footplate's outline and a gap."""
    x, y, z = _bend(anatomy, tuple(p / np.float32(anatomy.scale) for p in points))
    if anatomy.mirror:
        x = -x
    hole = gap_mm - _outline(anatomy, x, z)
    return np.asarray(np.maximum(np.abs(y - 0.12) - 0.3, hole) * anatomy.scale, dtype=np.float32)


def incus(anatomy: Anatomy, points: tuple[Field, Field, Field], gap_mm: float) -> Field:
    """Return the field of the tip of an incus above the head."""
    x, y, z = _bend(anatomy, tuple(p / np.float32(anatomy.scale) for p in points))
    if anatomy.mirror:
        x = -x
    start = anatomy.height + gap_mm + 0.33
    cap = _ellipsoid((x - anatomy.offset, y - start, z), (0.4, 0.33, 0.35))
    shaft = np.maximum(np.hypot(x - anatomy.offset - 0.4 * (y - start), z) - 0.3, start - y)
    return np.asarray(np.minimum(cap, shaft) * anatomy.scale, dtype=np.float32)


def _outline(a: Anatomy, x: Field, z: Field) -> Field:
    """Return about the distance from a superellipse whose one long side is flatter, as footplates have it."""
    w = z + 0.12 * (1.0 - (x / (0.5 * a.length)) ** 2) * np.sign(a.offset + 1e-9)
    r = (np.abs(x / (0.5 * a.length)) ** 2.5 + np.abs(w / (0.5 * a.width)) ** 2.5) ** 0.4
    return np.asarray((r - 1.0) * 0.5 * a.width)


def _rod(p: tuple[Field, Field, Field], a: Array, b: Array, c: Array, radius: float) -> Field:
    """Return the distance from a rod along a quadratic curve: the least over short straight pieces."""
    t = np.linspace(0.0, 1.0, 9)[:, None]
    nodes = (1 - t) ** 2 * a + 2 * t * (1 - t) * b + t**2 * c
    least: Field | None = None
    for u, v in pairwise(nodes):
        along = (v - u).astype(np.float32)
        share = sum((p[k] - np.float32(u[k])) * along[k] for k in range(3)) / np.float32(along @ along)
        share = np.clip(share, 0.0, 1.0)
        square = sum((p[k] - np.float32(u[k]) - share * along[k]) ** 2 for k in range(3))
        least = square if least is None else np.minimum(least, square)
    return np.asarray(np.sqrt(least) - np.float32(radius))


def _gutter(a: Anatomy, p: tuple[Field, Field, Field], rods: Field, reach: float, top: float) -> Field:
    """Hollow both crura towards the opening between them: walls of about 100 um."""
    x, y, z = p
    inner = rods + 0.1
    # Towards the middle the gutter is open, and ends before footplate and head.
    shift = np.where(x < 0.3 * a.offset, 1.0, -1.0) * 0.14
    moved = (x - shift, y, z)
    legs = []
    for side, radius in zip((-1.0, 1.0), a.crus, strict=True):
        foot = np.array([side * reach, 0.7 * a.thickness + a.curl * 0.5, 0.0])
        knee = np.array([side * reach * 1.05, 0.6 * a.height, 0.0])
        legs.append(_rod(moved, foot, knee, np.array([a.offset, top - 0.1, 0.0]), radius - 0.08))
    inner = np.minimum(inner, np.minimum(legs[0], legs[1]))
    inner = np.maximum(inner, np.maximum(a.thickness + 0.15 - y, y - top + 0.5))
    return np.asarray(np.maximum(rods, -inner))


def _between(a: Anatomy, x: Field, y: Field, reach: float, top: float) -> Field:
    """Return the field of the opening between the crura, seen along z."""
    half = reach * np.sqrt(np.clip(1.0 - (np.clip(y, 0.0, top) / top) ** 2, 0.0, 1.0))
    return np.asarray(np.abs(x - a.offset * y / top) - half)


def _ellipsoid(p: tuple[Field, Field, Field], radii: tuple[float, float, float]) -> Field:
    r = np.sqrt(sum((p[k] / np.float32(radii[k])) ** 2 for k in range(3)))
    return np.asarray((r - 1.0) * np.float32(min(radii)))


def _join(a: Field, b: Field, how: np.ufunc, rounding: float = 0.08) -> Field:
    """Join two bodies with a fillet (minimum), or cut one by the other with a rounded edge (maximum)."""
    near = np.clip(rounding - np.abs(a - b), 0.0, None)
    fillet = 0.25 * near * near / np.float32(rounding)
    return np.asarray(how(a, b) + (fillet if how is np.maximum else -fillet))


def _bend(a: Anatomy, p: tuple[Field, ...]) -> tuple[Field, Field, Field]:
    """Displace points by quadratic polynomials through the lattice over the body's box."""
    if not np.any(a.bend):
        return p[0], p[1], p[2]
    size = np.array([1.6, 1.75, 0.9], dtype=np.float32)
    middle = (0.0, 1.65, 0.0)
    bases = []
    for k in range(3):
        t = np.clip((p[k] - np.float32(middle[k])) / size[k], -1.3, 1.3)
        bases.append((0.5 * t * (t - 1.0), 1.0 - t * t, 0.5 * t * (t + 1.0)))
    moved = [q.astype(np.float32) for q in p]
    for i, along_x in enumerate(bases[0]):
        for j, along_y in enumerate(bases[1]):
            both = along_x * along_y
            for k, along_z in enumerate(bases[2]):
                weight = both * along_z
                for axis in range(3):
                    moved[axis] = moved[axis] + np.float32(a.bend[i, j, k, axis]) * weight
    return moved[0], moved[1], moved[2]
