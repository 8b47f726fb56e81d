"""Nodes, coordinate systems and units of a universal file, from the datasets that pyuff gives."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from kinematics.readers.recording import unknown_vector
from kinematics.readers.text import CUT
from stapeskit.arrays import Array
from stapeskit.faults import Fault, Place
from stapeskit.warnings import Notice

_FARTHEST_M = 1e3  # a point farther away is a wrong unit or a damaged number

System = tuple[Array, Array]
"""Axes in rows (3, 3) and origin (3,) of a coordinate system."""


@dataclass(frozen=True)
class Geometry:
    """Positions of nodes in m, their axes of measurement in rows, and the length factor of dataset 164."""

    positions_m: Mapping[int, Array] = field(default_factory=dict)
    axes: Mapping[int, Array] = field(default_factory=dict)
    length_factor: float | None = None
    notices: tuple[Notice, ...] = ()

    def direction(self, node: int, code: int) -> Array:
        """Return the unit vector of a direction +-1..3 at a node; NaN for a scalar."""
        if not 1 <= abs(code) <= 3:
            return unknown_vector()
        return np.asarray(self.axes.get(node, np.eye(3))[abs(code) - 1] * np.sign(code))


def read_geometry(
    sets: Sequence[Mapping[str, Any]], file: str, used: set[int], faults: list[Fault]
) -> Geometry:
    """Read units, coordinate systems and the nodes that functions refer to.

    Notes
    -----
    Dataset 164: SI = file value / factor. Dataset 15 gives coordinates in the node's definition system,
    dataset 2411 in the global one. Measured directions are those of the displacement system of a node.
    """
    factor: float | None = None
    systems: dict[int, System] = {}
    nodes: dict[int, tuple[Array, int, int, Place]] = {}
    for one in sets:
        where = Place(file, "dataset", (one["place"],))
        if one["type"] == 164:
            factor = float(one["length"])
            if not 0.0 < factor < np.inf:
                faults.append(Fault("the length factor of dataset 164", "positive", f"{factor:g}", where))
        elif one["type"] in (18, 2420):
            systems |= _systems(one, where, faults)
        elif one["type"] in (15, 2411):
            _read_nodes(one, where, nodes, faults)
    positions: dict[int, Array] = {}
    axes: dict[int, Array] = {}
    missing: set[int] = set()
    nowhere = (np.eye(3), np.zeros(3))
    for label in sorted(used & set(nodes)):
        position, defined, measured, where = nodes[label]
        missing |= {defined, measured} - {0, *systems}
        turn, origin = systems.get(defined, nowhere)
        positions[label] = (position @ turn + origin) / (factor or 1.0)
        axes[label] = systems.get(measured, nowhere)[0]
        if not np.all(np.abs(positions[label]) < _FARTHEST_M):
            got, thing = f"{positions[label].tolist()} m", f"the position of node {label}"
            faults.append(Fault(thing, f"within {_FARTHEST_M:g} m", got, where, "Export it again"))
    notices: tuple[Notice, ...] = ()
    listed = ", ".join(map(str, sorted(missing)))
    if missing and systems:
        step = "Export the coordinate systems too, or the geometry in global coordinates"
        thing = f"coordinate system {listed}"
        faults.append(Fault(thing, "described in dataset 18 or 2420", "nodes that refer to it", file, step))
    elif missing:
        text = (
            f"{file}: nodes refer to coordinate system {listed}, and the file describes none: it was taken "
            "for the global one."
        )
        notices = (Notice("coordinate_system_missing", text),)
    return Geometry(positions, axes, factor, notices)


def _read_nodes(
    one: Mapping[str, Any], where: Place, nodes: dict[int, tuple[Array, int, int, Place]], faults: list[Fault]
) -> None:
    """Add the nodes of a dataset: position, definition and displacement system by their labels."""
    columns = [np.atleast_1d(one[name]) for name in ("node_nums", "def_cs", "disp_cs", "x", "y", "z")]
    if len({len(column) for column in columns}) > 1:
        faults.append(Fault("the nodes", "given by label and three coordinates", "others", where, CUT))
        return
    xyz = np.column_stack(columns[3:]).astype(float)
    numbers = zip(*(column.astype(int).tolist() for column in columns[:3]), strict=True)
    for (label, defined, displaced), place in zip(numbers, xyz, strict=True):
        known = nodes.get(label)
        if known is not None and not np.allclose(known[0], place, rtol=1e-5, atol=1e-12):
            got = f"{known[0].tolist()} and {place.tolist()}"
            faults.append(Fault(f"the position of node {label}", "one", got, where, "Remove the wrong one"))
        nodes[label] = (place, defined if one["type"] == 15 else 0, displaced, where)


def _systems(one: Mapping[str, Any], where: Place, faults: list[Fault]) -> dict[int, System]:
    """Return the coordinate systems of a dataset by their numbers."""
    names = ("cs_num", "cs_type") if one["type"] == 18 else ("CS_sys_labels", "CS_types")
    labels, kinds = (np.atleast_1d(one[name]).astype(int).tolist() for name in names)
    if one["type"] == 2420:
        frames = np.asarray(one["CS_matrices"], dtype=float).reshape(-1, 4, 3)
        turns, origins = list(frames[:, :3]), list(frames[:, 3])
    else:
        defined = [np.reshape(one[name], (-1, 3)).astype(float) for name in ("ref_o", "x_point", "xz_point")]
        turns, origins = [_axes_of(*points) for points in zip(*defined, strict=True)], list(defined[0])
    nested = bool(np.any(np.asarray(one.get("ref_cs_num", 0), dtype=int)))
    for label, kind, turn in zip(labels, kinds, turns, strict=True):
        rotation = np.allclose(turn @ turn.T, np.eye(3), atol=1e-4) and np.linalg.det(turn) > 0.0
        if kind != 0 or nested or not rotation:
            want = "cartesian, right-handed and described in the global one"
            step = "Export the geometry in global cartesian coordinates"
            faults.append(Fault(f"coordinate system {label}", want, "another one", where, step))
    return dict(zip(labels, zip(turns, origins, strict=True), strict=True))


def _axes_of(origin: Array, on_x: Array, on_xz: Array) -> Array:
    """Return the axes in rows of a system by a point on +x and one in +xz; NaN where they span no plane."""
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        x = (on_x - origin) / np.linalg.norm(on_x - origin)
        z = (on_xz - origin) - (on_xz - origin) @ x * x
        z = z / np.linalg.norm(z)
        return np.array([x, np.cross(z, x), z])
