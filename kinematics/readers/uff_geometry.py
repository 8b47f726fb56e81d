"""Nodes, coordinate systems and units of a universal file, from the datasets that pyuff gives."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from kinematics.readers.recording import unknown_vector
from stapeskit.arrays import Array
from stapeskit.faults import Fault, Place
from stapeskit.warnings import Notice

System = tuple[Array, Array]
"""Axes in rows (3, 3) and origin (3,) of a coordinate system."""

_GLOBAL: System = (np.eye(3), np.zeros(3))


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
    systems: dict[int, System] = {0: _GLOBAL}
    nodes: dict[int, tuple[Array, int, int]] = {}
    for one in sets:
        where = Place(file, "dataset", (one["place"],))
        if one["type"] == 164:
            factor = float(one["length"])
        elif one["type"] in (18, 2420):
            systems |= _systems(one, where, faults)
        elif one["type"] in (15, 2411):
            for label, node in _nodes(one).items():
                if label in nodes and not np.allclose(nodes[label][0], node[0], rtol=1e-5, atol=1e-12):
                    got = f"{nodes[label][0].tolist()} and {node[0].tolist()}"
                    thing, step = f"the position of node {label}", "Remove the wrong one"
                    faults.append(Fault(thing, "one", got, where, step))
                nodes[label] = node
    if factor is not None and not 0.0 < factor < np.inf:
        faults.append(Fault("the length factor of dataset 164", "positive", f"{factor:g}", file))
        factor = None
    known = {label: node for label, node in nodes.items() if label in used}
    missing = {system for node in known.values() for system in node[1:]} - set(systems)
    listed, notices = ", ".join(map(str, sorted(missing))), []
    if missing and len(systems) > 1:
        step = "Export the coordinate systems too, or the geometry in global coordinates"
        thing, want = f"coordinate system {listed}", "described in dataset 18 or 2420"
        faults.append(Fault(thing, want, "nodes that refer to it", file, step))
    elif missing:
        text = (
            f"{file}: nodes refer to coordinate system {listed}, and the file describes none: it was taken "
            "for the global one."
        )
        notices.append(Notice("axes_assumed", text))
    positions = {}
    for label, (position, defined, _) in known.items():
        turn, origin = systems.get(defined, _GLOBAL)
        positions[label] = (position @ turn + origin) / (factor or 1.0)
    axes = {label: systems.get(measured, _GLOBAL)[0] for label, (_, _, measured) in known.items()}
    return Geometry(positions, axes, factor, tuple(notices))


def _nodes(one: Mapping[str, Any]) -> dict[int, tuple[Array, int, int]]:
    """Return position, definition and displacement system of the nodes of a dataset by their labels."""
    columns = [np.atleast_1d(one[name]) for name in ("node_nums", "def_cs", "disp_cs", "x", "y", "z")]
    labels, defined, displaced = (column.astype(int).tolist() for column in columns[:3])
    defined = defined if one["type"] == 15 else [0] * len(labels)
    xyz = np.column_stack(columns[3:]).astype(float)
    return dict(zip(labels, zip(xyz, defined, displaced, strict=True), strict=True))


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
