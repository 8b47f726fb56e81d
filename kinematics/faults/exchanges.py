"""Exchanged names: two points, two beams of a point, or two lasers that were taken for each other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from kinematics.joint.expected import Layout
from kinematics.joint.tangents import Geometry


@dataclass(frozen=True)
class Exchange:
    """Channels that changed places: what is exchanged, (first, second), and the true geometry."""

    what: str
    first: tuple[int, ...]
    second: tuple[int, ...]
    geometry: Geometry

    @property
    def channels(self) -> tuple[int, ...]:
        """All of them."""
        return self.first + self.second


def exchanges(
    geometry: Geometry, layout: Layout, live: Sequence[int], suspects: Sequence[int]
) -> list[Exchange]:
    """List the exchanges in which a suspected channel takes part.

    Two points change places when they have equally many channels: their positions alone (names in points.csv)
    or with their beams (names of rows). Two lasers change with all their channels, two beams at one point.
    """
    points = layout.by_point(live)
    names = {layout.points[channel] for channel in suspects}
    found: list[Exchange] = []
    for one, other in combinations(points, 2):
        first, second = points[one], points[other]
        if (one in names or other in names) and len(first) == len(second):
            found.append(_exchange("points", geometry, first, second))
            if np.any(np.abs(geometry.directions[first] - geometry.directions[second]) > 1e-6):
                found.append(_exchange("rows", geometry, first, second))
    for name in names & set(points):
        found += [_exchange("beams", geometry, [a], [b]) for a, b in combinations(points[name], 2)]
    for first, second in combinations(layout.by_laser(live).values(), 2):
        if len(first) == len(second):
            found.append(_exchange("lasers", geometry, first, second))
    return found


def _exchange(what: str, geometry: Geometry, first: Sequence[int], second: Sequence[int]) -> Exchange:
    one, other = list(first), list(second)
    positions, directions = geometry.positions_m.copy(), geometry.directions.copy()
    if what in ("points", "rows"):
        positions[one], positions[other] = geometry.positions_m[other[0]], geometry.positions_m[one[0]]
    if what != "points":
        directions[one], directions[other] = geometry.directions[other], geometry.directions[one]
    changed = replace(geometry, positions_m=positions, directions=directions)
    what = "points" if what == "rows" else what
    return Exchange(what, tuple(first), tuple(second), changed)


def distinct(exchange: Exchange, geometry: Geometry) -> bool:
    """Return whether the exchange changes anything."""
    changed = exchange.geometry
    own = list(exchange.channels)
    return not (
        np.allclose(changed.positions_m[own], geometry.positions_m[own])
        and np.allclose(changed.directions[own], geometry.directions[own])
    )
