"""Geometry in a universal file: nodes (15, 2411), units (164) and coordinate systems (18, 2420)."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np

from legacy.kinematics.errors import KinematicsError
from legacy.kinematics.readers.recording import unknown_vector
from legacy.kinematics.readers.text import shown
from legacy.kinematics.readers.uff.datasets import CUT, Dataset
from legacy.kinematics.readers.uff.functions import fortran_number
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.faults import Fault, collect_faults, raise_all
from legacy.stapeskit.warnings import Notice

Node = tuple[Array, int, int, str]
# Numbers of datasets (SDRC universal file format): nodes, units, coordinate systems.
_NODES, _PRECISE_NODES, _UNITS, _SYSTEMS, _PRECISE_SYSTEMS = 15, 2411, 164, 18, 2420
# A point farther away is a wrong unit or a damaged number.
_FAR_M = 1e3
_SHAPES = {0: "cartesian", 1: "cylindrical", 2: "spherical"}
_REAL = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[EeDd][+-]?\d+|[+-]\d{3})?")


@dataclass(frozen=True)
class System:
    """A coordinate system: axes in rows and origin, seen from its parent system, in file units."""

    label: int
    shape: int
    parent: int
    axes: Array
    origin: Array


@dataclass(frozen=True)
class Geometry:
    """What a file says of its nodes.

    Attributes
    ----------
    positions_m : mapping of int to ndarray, (3,)
        In the global system, m.
    axes : mapping of int to ndarray, (3, 3)
        Rows are the directions +x, +y, +z of measurement at a node, in the global system.
    length_factor : float or None
        File length per metre, by dataset 164; None without it.
    """

    positions_m: Mapping[int, Array] = field(default_factory=dict)
    axes: Mapping[int, Array] = field(default_factory=dict)
    length_factor: float | None = None
    notices: tuple[Notice, ...] = ()

    @property
    def units(self) -> str:
        """What the file says about coordinates and lengths, for people."""
        stated = self.length_factor is not None
        units = f"lengths by dataset 164, {self.length_factor:g} per metre" if stated else "lengths as metres"
        return f"global axes of the file, {units}"

    def position_mm(self, node: int) -> Array:
        """Return the position of a node, (3,), NaN when unknown."""
        position = self.positions_m.get(node)
        return unknown_vector() if position is None else position * 1e3

    def direction(self, node: int, code: int) -> Array:
        """Return the unit vector of a direction +-1..3 at a node; NaN for a scalar."""
        if not 1 <= abs(code) <= 3:
            return unknown_vector()
        return np.asarray(self.axes.get(node, np.eye(3))[abs(code) - 1] * np.sign(code))


def read_geometry(datasets: Iterable[Dataset], file: str, used: set[int]) -> Geometry:
    """Read nodes, units and coordinate systems.

    Parameters
    ----------
    used : set of int
        The nodes that functions refer to: only what these need must be right.

    Raises
    ------
    KinematicsError
        A record is cut short or no number, a node has two positions, or a used node refers to a coordinate
        system that the file lacks, or to one that is not cartesian.

    Notes
    -----
    Dataset 164: SI = file value / factor. Dataset 15 gives coordinates in the node's definition system,
    dataset 2411 in the part's own. Measured directions are those of the displacement system. Dataset 2420
    holds the axes in its first three rows and the origin in the fourth.
    """
    factor: float | None = None
    systems: dict[int, System] = {}
    nodes: dict[int, Node] = {}
    faults: list[Fault] = []
    for dataset in datasets:
        if dataset.number == _UNITS:
            with collect_faults(faults):
                factor = _length_factor(dataset, dataset.at(file, 2))
        elif dataset.number in (_SYSTEMS, _PRECISE_SYSTEMS):
            systems |= {system.label: system for system in _systems(dataset, file, faults)}
        elif dataset.number in (_NODES, _PRECISE_NODES):
            for label, entry in _nodes(dataset, file, faults):
                if label in nodes and not np.allclose(nodes[label][0], entry[0], rtol=1e-5, atol=1e-12):
                    faults.append(
                        Fault(
                            f"the position of node {label}",
                            "one",
                            f"{nodes[label][0].tolist()} and {entry[0].tolist()}",
                            f"{nodes[label][3]} and {entry[3].removeprefix(file + ', ')}",
                            "Remove the wrong one",
                        )
                    )
                nodes[label] = entry
    raise_all(KinematicsError, faults)
    positions: dict[int, Array] = {}
    axes: dict[int, Array] = {}
    missing_systems: set[int] = set()
    for label in sorted(used & set(nodes)):
        position, defined_in, measured_in, where = nodes[label]
        wrong: list[Fault] = []
        for number in {defined_in, measured_in} - {0}:
            if number not in systems and not systems:
                missing_systems.add(number)
            wrong += _system_faults(number, systems, label, where) if systems else []
        faults += wrong
        if wrong:
            continue
        with np.errstate(over="ignore", invalid="ignore"):
            turn, origin = _to_global(defined_in, systems)
            positions[label] = (position @ turn + origin) / (factor or 1.0)
        if not np.all(np.abs(positions[label]) < _FAR_M):
            got = f"{positions[label].tolist()} m"
            thing = f"the position of node {label}"
            faults.append(Fault(thing, f"within {_FAR_M:g} m", got, where, "Export it again"))
        axes[label] = _to_global(measured_in, systems)[0]
    raise_all(KinematicsError, faults)
    notices = []
    if missing_systems:
        listed = ", ".join(map(str, sorted(missing_systems)))
        text = (
            f"{file}: nodes refer to coordinate system {listed}, and the file describes none: "
            "it was taken for the global one."
        )
        notices.append(Notice("coordinate_system_missing", text))
    return Geometry(positions, axes, factor, tuple(notices))


def _length_factor(dataset: Dataset, where: str) -> float:
    numbers = _reals(" ".join(dataset.lines[1:]))
    if not numbers or not numbers[0] > 0.0:
        got = f"{numbers[0]:g}" if numbers else shown(" ".join(dataset.lines[1:])) or "none"
        raise KinematicsError.of(
            "the length factor of dataset 164", "positive", got, where, "Export it again"
        )
    return numbers[0]


def _reals(text: str) -> list[float]:
    """Read Fortran numbers, separated by blanks or the next sign; none if there is other text."""
    numbers: list[float] = []
    last = 0
    for match in _REAL.finditer(text):
        between, word = text[last : match.start()], match[0]
        if between.strip() or (not between and numbers and word[0] not in "+-"):
            return []
        last = match.end()
        numbers.append(fortran_number(word))
    return [] if text[last:].strip() else numbers


def _parse_integers(text: str, count: int, thing: str, where: str) -> list[int]:
    words = text.split()[:count]
    if len(words) < count or not all(re.fullmatch(r"[+-]?\d{1,18}", word) for word in words):
        raise KinematicsError.of(thing, f"{count} whole numbers", shown(text), where, "Export it again")
    return [int(word) for word in words]


def _vectors(text: str, count: int, thing: str, where: str) -> Array:
    numbers = _reals(text)
    if len(numbers) != count or not np.all(np.isfinite(numbers)):
        raise KinematicsError.of(thing, f"{count} numbers", shown(text), where, CUT)
    return np.array(numbers).reshape(-1, 3)


def _nodes(dataset: Dataset, file: str, faults: list[Fault]) -> list[tuple[int, Node]]:
    """Return label and (position, definition system, displacement system, place) of every node."""
    nodes = []
    lines = _number(dataset)
    if dataset.number == _NODES:
        for row, line in lines:
            where = dataset.at(file, row)
            with collect_faults(faults):
                label, defined, measured, _ = _parse_integers(line[:40], 4, "a node", where)
                position = _vectors(line[40:], 3, f"the position of node {label}", where)[0]
                nodes.append((label, (position, defined, measured, where)))
        return nodes
    for (row, head), (below, line) in zip(lines[::2], [*lines[1::2], (0, "")], strict=False):
        with collect_faults(faults):
            label, _, measured, _ = _parse_integers(head, 4, "a node", dataset.at(file, row))
            where = dataset.at(file, below or row)
            position = _vectors(line, 3, f"the position of node {label}", where)[0]
            nodes.append((label, (position, 0, measured, where)))
    return nodes


def _number(dataset: Dataset, start: int = 0) -> list[tuple[int, str]]:
    """Return the lines that hold something, with their numbers from 1."""
    return [(row, line) for row, line in enumerate(dataset.lines[start:], start + 1) if line.strip()]


def _systems(dataset: Dataset, file: str, faults: list[Fault]) -> list[System]:
    """Return the coordinate systems of dataset 18, or of 2420, whose first two lines name the part."""
    old = dataset.number == _SYSTEMS
    skip, size, read = (0, 4, _old_system) if old else (2, 6, _new_system)
    systems: list[System] = []
    lines = _number(dataset, skip)
    for start in range(0, len(lines), size):
        with collect_faults(faults):
            part = [line for _, line in lines[start : start + size]]
            systems.append(read(part, dataset, file, lines[start][0]))
    return systems


def _old_system(part: list[str], dataset: Dataset, file: str, row: int) -> System:
    where = dataset.at(file, row)
    if len(part) < 4:
        raise KinematicsError.of("a coordinate system", "of 4 lines", f"{len(part)}", where, CUT)
    label, shape, parent, _, _ = _parse_integers(part[0], 5, "a coordinate system", where)
    thing = f"the definition of coordinate system {label}"
    origin, on_x, on_xz = _vectors(part[2] + " " + part[3], 9, thing, where)
    x = on_x - origin
    with np.errstate(over="ignore", invalid="ignore"):
        z = (on_xz - origin) - np.dot(on_xz - origin, x) / max(np.dot(x, x), 1e-300) * x
        long, wide = np.linalg.norm(x), np.linalg.norm(z)
    if not (0.0 < long < np.inf and 1e-9 * long < wide < np.inf):
        got = "points on one line, or too far away"
        raise KinematicsError.of(thing, "three points that span a plane", got, where, "Correct it")
    x, z = x / long, z / wide
    return System(label, shape, parent, np.array([x, np.cross(z, x), z]), origin)


def _new_system(part: list[str], dataset: Dataset, file: str, row: int) -> System:
    where = dataset.at(file, row)
    if len(part) < 6:
        raise KinematicsError.of("a coordinate system", "of 6 lines", f"{len(part)}", where, CUT)
    label, shape = _parse_integers(part[0], 2, "a coordinate system", where)
    thing = f"the matrix of coordinate system {label}"
    rows = _vectors(" ".join(part[2:]), 12, thing, where)
    with np.errstate(over="ignore", invalid="ignore"):
        turned = np.allclose(rows[:3] @ rows[:3].T, np.eye(3), atol=1e-4) and np.linalg.det(rows[:3]) > 0.0
    if not turned:
        got = np.array2string(rows[:3], precision=4, separator=", ").replace("\n", "")
        raise KinematicsError.of(thing, "a rotation, right-handed", got, where, "Correct it")
    return System(label, shape, 0, rows[:3], rows[3])


def _system_faults(number: int, systems: Mapping[int, System], node: int, where: str) -> list[Fault]:
    """List what keeps a node from being placed: an unknown, curved or circular coordinate system."""
    visited: set[int] = set()
    while number != 0:
        if number in visited or number not in systems:
            got = (
                "one that refers to itself"
                if number in visited
                else "a number that the file does not describe"
            )
            step = "Export the coordinate systems too, or the geometry in global coordinates"
            thing = f"coordinate system {number} of node {node}"
            return [Fault(thing, "described in dataset 18 or 2420", got, where, step)]
        if systems[number].shape != 0:
            shape = _SHAPES.get(systems[number].shape, f"type {systems[number].shape}")
            step = "Export the geometry in cartesian coordinates"
            return [Fault(f"coordinate system {number} of node {node}", "cartesian", shape, where, step)]
        visited.add(number)
        number = systems[number].parent
    return []


def _to_global(number: int, systems: Mapping[int, System]) -> tuple[Array, Array]:
    """Return axes (rows) and origin of a system seen from the global one, in file units."""
    if number == 0 or number not in systems:
        return np.eye(3), np.zeros(3)
    system = systems[number]
    axes, origin = _to_global(system.parent, systems)
    return system.axes @ axes, system.origin @ axes + origin
