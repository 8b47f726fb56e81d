"""Stapes to simulate: the real one of the OpenEar library, made ones, and foreign families of anatomy.

Body axes are x anterior, y lateral, z superior in a left ear; mm. A stapes is given in its own footplate
frame (simulate.footplate), so the truth of every frame is exact.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from simulate.footplate import footplate_frame
from simulate.foreign import FAMILIES, anatomy_field, draw_anatomy
from simulate.solids import Solid, outward, solid_of_field
from stapeskit.arrays import Array
from stapeskit.frames import RigidTransform

_HERE = Path(__file__).resolve().parent
# Beside this file in an installed package, with the samples in the source tree.
_PLACES = [folder / "openear_stapes.ply" for folder in (_HERE, _HERE.parent / "sample_volumes")]
OPENEAR_PLY = next((path for path in _PLACES if path.is_file()), _PLACES[0])
# Where its footplate frame lies in the file's coordinates, by the definition in `simulate.footplate`.
_FILE_FROM_FOOTPLATE = (
    (0.13475956035202305, -0.49824303701220585, -0.8565008680454349, 0.6718597062233791),
    (-0.6547993840165206, 0.6039758313473972, -0.4543687509499369, -0.7883387084122394),
    (0.743691890224248, 0.6220667739214772, -0.24485771623048996, -0.6193550590240757),
    (0.0, 0.0, 0.0, 1.0),
)


@dataclass(frozen=True, kw_only=True)
class Stapes:
    """Which stapes, and how it is deformed."""

    # one of STAPES: ``openear`` (a real one), ``analytic`` (symmetric, frame known by construction), or
    # ``foreign `` with one of simulate.foreign.FAMILIES
    family: str = "openear"
    scale: float = 1.0  # of all lengths
    stretch: tuple[float, float, float] = (1.0, 1.0, 1.0)  # of x, y, z
    warp: float = 0.0  # amplitude of a smooth random displacement, mm
    mirrored: bool = False  # A right ear: z reversed
    seed: int = 1  # of the warp and of a foreign anatomy
    step_mm: float = 0.04  # mesh of the made ones


@functools.lru_cache(maxsize=512)
def stapes_solid(stapes: Stapes) -> Solid:
    """Return the exact mesh of a stapes in its own footplate frame, mm."""
    plain = replace(stapes, scale=1.0, stretch=(1.0, 1.0, 1.0), warp=0.0, mirrored=False)
    if plain == stapes:
        return _in_own_frame(stapes)
    solid = stapes_solid(plain)
    if stapes.warp:
        solid = _warped(solid, stapes.warp, stapes.seed)
    factors = stapes.scale * np.asarray(stapes.stretch) * [1.0, 1.0, -1.0 if stapes.mirrored else 1.0]
    solid = solid.stretched(factors)
    if np.array_equal(np.abs(factors), np.ones(3)) and not stapes.warp:
        return solid  # a reflection takes the frame with it
    return solid.moved(footplate_frame(solid).inverse())


def _in_own_frame(stapes: Stapes) -> Solid:
    if stapes.family == "openear":
        frame = RigidTransform(np.array(_FILE_FROM_FOOTPLATE), "file", "footplate")
        return read_ply(OPENEAR_PLY).moved(frame.inverse())
    solid = STAPES[stapes.family](stapes)
    return solid.moved(footplate_frame(solid).inverse())


def read_ply(path: Path) -> Solid:
    """Read a binary PLY of float corners and triangles; corners are sorted and joined where they coincide."""
    content = path.read_bytes()
    end = content.index(b"end_header\n") + len(b"end_header\n")
    words = content[:end].decode("ascii").split()
    corners, triangles = (int(words[words.index(name) + 1]) for name in ("vertex", "face"))
    vertices = np.frombuffer(content, "<f4", 3 * corners, end).reshape(-1, 3).astype(float)
    rows = np.frombuffer(
        content, np.dtype([("n", "u1"), ("corner", "<i4", (3,))]), triangles, end + 12 * corners
    )
    unique, place = np.unique(vertices, axis=0, return_inverse=True)
    return outward(unique, np.ascontiguousarray(place.reshape(-1)[rows["corner"].astype(np.int64)]))


def _warped(solid: Solid, size_mm: float, seed: int) -> Solid:
    """Displace a solid by a sum of three smooth waves of about 4 mm; no fold for sizes up to 0.3 mm."""
    rng = np.random.default_rng([seed, 17])
    moved = solid.vertices_mm.copy()
    for _ in range(3):
        wave = rng.normal(size=3)
        wave *= 2.0 * np.pi / 4.0 / np.linalg.norm(wave)
        phase = rng.uniform(0.0, 2.0 * np.pi)
        way = rng.normal(size=3) / np.sqrt(9.0)
        moved += size_mm * np.sin(solid.vertices_mm @ wave + phase)[:, None] * way
    return outward(moved, solid.faces)


def rounded_footplate(points: Array) -> Array:
    """Return about the distance (mm) from an elliptic plate of 2.8 x 1.3 x 0.3 mm with a rounded rim."""
    x, y, z = np.moveaxis(points, -1, 0)
    a, b, thick, rim = 1.4, 0.65, 0.3, 0.1
    level = np.hypot(x / a, z / b)
    across = level * (level - 1.0) / np.maximum(np.hypot(x / a**2, z / b**2), 1e-9) + rim
    along = np.abs(y - 0.5 * thick) - 0.5 * thick + rim
    inside = np.minimum(np.maximum(across, along), 0.0) - rim
    return np.asarray(inside + np.hypot(np.maximum(across, 0.0), np.maximum(along, 0.0)))


def capsule(points: Array, start: object, end: object, radius: float) -> Array:
    """Return the distance in mm from a capsule's surface, negative inside."""
    a, b = np.asarray(start, dtype=float), np.asarray(end, dtype=float)
    share = np.clip(((points - a) @ (b - a)) / ((b - a) @ (b - a)), 0.0, 1.0)
    return np.asarray(np.linalg.norm(points - a - share[..., None] * (b - a), axis=-1) - radius)


def _analytic(stapes: Stapes) -> Solid:
    """Mesh a footplate, two crura and a head; nodes lie symmetric about x = 0 and z = 0."""
    head = np.array([0.05, 3.1, 0.0])

    def field(points: Array) -> Array:
        parts = [
            rounded_footplate(points),
            capsule(points, (-0.95, 0.25, 0.0), head - [0.35, 0.6, 0.0], 0.2),
            capsule(points, (0.95, 0.25, 0.0), head - [-0.25, 0.6, 0.0], 0.17),
            capsule(points, head - [0.0, 0.45, 0.0], head, 0.42),
        ]
        return np.asarray(np.minimum.reduce(parts))

    step = stapes.step_mm
    half = [step * (0.5 + np.floor(reach / step)) for reach in (1.8, 1.0)]
    low, high = (-half[0], -0.2 + 0.31 * step, -half[1]), (half[0], 3.9, half[1])
    return solid_of_field(field, low, high, step)


def _foreign(stapes: Stapes) -> Solid:
    anatomy = draw_anatomy(stapes.family.removeprefix("foreign "), np.random.default_rng([stapes.seed, 19]))
    low, high = (-2.1, -0.6, -1.25), (2.1, 4.5, 1.25)
    return solid_of_field(lambda points: anatomy_field(anatomy, points), low, high, stapes.step_mm)


STAPES: dict[str, Callable[[Stapes], Solid]] = {
    "openear": lambda _: read_ply(OPENEAR_PLY),
    "analytic": _analytic,
    **{f"foreign {family}": _foreign for family in FAMILIES},
}
"""Makers of stapes by family; a foreign family of the table in `simulate.foreign` is named with a prefix."""
