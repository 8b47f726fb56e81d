"""Nodes and coordinate systems of universal files: datasets 15, 2411, 18 and 2420."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from stapeskit.arrays import Array
from stapeskit.faults import Fault, Place, list_some
from stapeskit.warnings import Notice

Dataset = Mapping[str, Any]
"""A dataset as pyuff gives it, with its ``place`` in the file."""

_GLOBAL = (np.eye(3), np.zeros(3))  # axes in rows and origin


def nodes_of(
    sets: Sequence[Dataset], used: set[int], file: str, faults: list[Fault], notices: list[Notice]
) -> dict[int, tuple[Array, Array]]:
    """Return positions (3,), in the file's unit, and axes of measurement in rows of the nodes that are used.

    Dataset 15 gives coordinates in the node's definition system. Dataset 2411 gives them in the global one,
    but programs differ: an export system that turns or shifts is refused. Where a file describes no system,
    those of its nodes are taken for the global one, with a notice.
    """
    systems: dict[int, tuple[Array, Array] | None] = {0: _GLOBAL}
    for one in sets:
        systems |= _systems(one) if one["type"] in (18, 2420) else {}
    nodes, unknown, moved = dict[int, tuple[Array, Array]](), set[int](), set[int]()
    for one in sets:
        if one["type"] not in (15, 2411):
            continue
        columns = [np.atleast_1d(one[name]) for name in ("node_nums", "def_cs", "disp_cs", "x", "y", "z")]
        for node, defined, measured, *xyz in np.column_stack(columns).astype(float).tolist():
            if int(node) not in used:
                continue
            pair = [int(defined) if one["type"] == 15 else 0, int(measured)]
            unknown |= {label for label in pair if systems.get(label) is None}
            turn, origin = systems.get(int(defined)) or _GLOBAL
            if one["type"] == 2411 and not (np.array_equal(turn, np.eye(3)) and not np.any(origin)):
                moved.add(int(defined))
            (turn, origin), (axes, _) = (systems.get(label) or _GLOBAL for label in pair)
            place = np.array(xyz) @ turn + origin
            known, _ = nodes.setdefault(int(node), (place, axes))
            if not np.allclose(known, place, rtol=1e-5, atol=1e-12):
                thing, got = f"the position of node {node:.0f}", f"{known.tolist()} and {place.tolist()}"
                where = Place(file, "dataset", (one["place"],))
                faults.append(Fault(thing, "one", got, where, "Remove the wrong one"))
    listed = ", ".join(map(str, sorted(unknown)))
    if moved:
        thing, got = (
            f"the nodes of dataset 2411 in system {list_some(map(str, sorted(moved)))}",
            "a system that turns or shifts",
        )
        step = "Export the geometry in global cartesian coordinates"
        faults.append(Fault(thing, "in the global system", got, file, step))
    if unknown and len(systems) > 1:
        want = "cartesian, right-handed and described in the global one, in dataset 18 or 2420"
        step = "Export the geometry in global cartesian coordinates"
        faults.append(Fault(f"coordinate system {listed}", want, "none or another one", file, step))
    elif unknown:
        text = (
            f"{file}: nodes refer to coordinate system {listed}, and the file describes none: it was taken "
            "for the global one."
        )
        notices.append(Notice("axes_assumed", text))
    return nodes


def _systems(one: Dataset) -> dict[int, tuple[Array, Array] | None]:
    """Return axes in rows and origin of coordinate systems by number; None for one that is not read."""
    names = ("cs_num", "cs_type") if one["type"] == 18 else ("CS_sys_labels", "CS_types")
    labels, kinds = (np.atleast_1d(one[name]).astype(int).tolist() for name in names)
    if one["type"] == 2420:
        frames = np.asarray(one["CS_matrices"], dtype=float).reshape(-1, 4, 3)
        turns, origins = frames[:, :3], frames[:, 3]
    else:  # the origin, a point on +x and one in the half plane of +x and +z
        points = [np.reshape(one[name], (-1, 3)).astype(float) for name in ("ref_o", "x_point", "xz_point")]
        origins, on_x, on_xz = points
        with np.errstate(all="ignore"):
            x = (on_x - origins) / np.linalg.norm(on_x - origins, axis=1)[:, None]
            y = np.cross(on_xz - origins, x)
            y /= np.linalg.norm(y, axis=1)[:, None]
        turns = np.stack([x, y, np.cross(x, y)], axis=1)
    nested = np.any(np.asarray(one.get("ref_cs_num", 0), dtype=int))
    found: dict[int, tuple[Array, Array] | None] = {}
    for label, kind, turn, origin in zip(labels, kinds, turns, origins, strict=True):
        rotation = np.allclose(turn @ turn.T, np.eye(3), atol=1e-4) and np.linalg.det(turn) > 0.0
        found[label] = (turn, origin) if kind == 0 and not nested and rotation else None
    return found
