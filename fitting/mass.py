"""The mass matrix of a fit: from a result of ct2mass, a mass.json, or a plain matrix in SI (M.csv)."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from stapeskit.arrays import Array
from stapeskit.faults import Fault, Place, StapeskitError, list_some, raise_all
from stapeskit.records.mass_file import HasMass, read_mass
from stapeskit.records.mass_matrix import MassMatrix
from stapeskit.records.mass_record import MassRecord
from stapeskit.spatial import DOF_NAMES, inertia_faults
from stapeskit.warnings import Notice

_SMALLEST, _LARGEST = 1e-30, 1e6  # kg, kg m2: of no body that is measured here


@dataclass(frozen=True)
class Inertia:
    """A mass matrix about the footplate centre in footplate axes, and where it comes from."""

    dof: tuple[str, ...]  # its degrees of freedom: those of the model, or all six
    matrix: Array  # (k, k): SI
    # (10, 10): covariance of its ten inertial parameters by source; only where it has all six degrees of
    # freedom
    contributions: Mapping[str, Array] = field(default_factory=dict)
    record: MassRecord | None = None  # the whole mass.json, where it is one
    file: Path | None = None
    notices: tuple[Notice, ...] = ()  # what was assumed of it
    source: Path | Mapping[str, Any] | None = None  # for the provenance

    @property
    def complete(self) -> bool:
        """Whether it has all six degrees of freedom."""
        return self.dof == DOF_NAMES

    @property
    def side(self) -> str:
        """``left``, ``right`` or empty: names z."""
        return str(self._of_record("frames").get("side") or "")

    @property
    def outline_mm(self) -> Array | None:
        """x and z of the footplate's outline (points, 2) in footplate axes; None without one."""
        found = self._of_record("found").get("footplate_outline_in_footplate_mm")
        outline = np.asarray([] if found is None else found, dtype=float)
        good = outline.ndim == 2 and outline.shape[1] in (2, 3) and len(outline) > 2
        return outline[:, [0, -1]] if good and np.all(np.isfinite(outline)) else None

    def _of_record(self, block: str) -> Mapping[str, Any]:
        return {} if self.record is None else self.record.raw.get(block) or {}

    def block(self, dof: tuple[str, ...]) -> Array:
        """Return the matrix of some of its degrees of freedom, (n, n)."""
        places = [self.dof.index(name) for name in dof]
        return self.matrix[np.ix_(places, places)]


def inertia_of(mass: Any, dof: tuple[str, ...], sign: str = "assumed") -> Inertia:
    """Take a mass in any form and check it against the degrees of freedom of the model.

    Parameters
    ----------
    mass : path, result of ct2mass, MassRecord, MassMatrix or array_like
        About the footplate centre in footplate axes; a plain CSV or array (SI) is (n, n) in the order of
        ``dof``, or (6, 6).
    sign : str
        Of products of inertia in a plain matrix: ``tensor``, ``positive``, or ``assumed`` to be the first.

    Raises
    ------
    StapeskitError
        It is none of these, its file is at fault, its shape does not fit, it is about another point or in
        other axes, or no body can have it.
    """
    path = Path(mass) if isinstance(mass, str | os.PathLike) else None
    if isinstance(mass, HasMass | MassRecord) or (path is not None and path.suffix.lower() == ".json"):
        known = read_mass(mass)
        whole = inertia_of(known.mass_matrix, dof)
        return replace(whole, record=known, file=known.file, source=known.provenance_input)
    if isinstance(mass, MassMatrix):
        if (mass.about, mass.axes) != ("footplate_centre", "footplate"):
            wanted = "about footplate_centre in footplate axes"
            got, step = f"about {mass.about} in {mass.axes} axes", "Take the block mass_matrix of mass.json"
            raise StapeskitError.of("the mass matrix", wanted, got, "", step)
        return Inertia(DOF_NAMES, mass.matrix, mass.contributions)
    if path is not None:
        return replace(_plain(read_mass_csv(path, dof), dof, sign, path.name), file=path, source=path)
    try:
        matrix = np.asarray(mass, dtype=float)
    except (TypeError, ValueError):
        wanted = "a file, a result of ct2mass or a matrix in SI"
        raise StapeskitError.of("the mass", wanted, type(mass).__name__) from None
    return _plain(matrix, dof, sign)


def _plain(matrix: Array, dof: tuple[str, ...], sign: str, where: str = "") -> Inertia:
    """Return a plain matrix with elements of the inertia tensor, and a warning where that is assumed."""
    own = dof if matrix.shape == (len(dof),) * 2 else DOF_NAMES
    if matrix.shape != (len(own),) * 2:
        wanted = f"{len(dof)} x {len(dof)} or 6 x 6"
        got = " x ".join(map(str, matrix.shape)) or "one number"
        step = f"Give M in the order of --dof, {','.join(dof)}, or of all six"
        raise StapeskitError.of("the mass matrix", wanted, got, where, step)
    turning = np.array([name in DOF_NAMES[3:] for name in own])
    products = np.outer(turning, turning) & ~np.eye(len(own), dtype=bool)
    matrix = np.where(products & (sign == "positive"), -matrix, matrix)
    _check(matrix, where)
    if sign != "assumed" or not np.any(matrix[products]):
        return Inertia(own, matrix)
    text = (
        "The mixed rotational entries of M were taken as elements of the inertia tensor, -integral of x z "
        "dm; with products of inertia of the other sign give --mass-sign positive, else --mass-sign tensor."
    )
    return Inertia(own, matrix, notices=(Notice("file_read", text),))


def _check(matrix: Array, where: str) -> None:
    """Refuse a matrix that is not finite, symmetric, positive definite and of a size that bodies have."""
    thing, diagonal = "the mass matrix", np.diag(matrix)
    if not np.all(np.isfinite(matrix)):
        raise StapeskitError.of(thing, "of finite numbers", "NaN or infinite values", where)
    if np.any((diagonal < _SMALLEST) | (diagonal > _LARGEST)):
        wanted = f"within {_SMALLEST:g} and {_LARGEST:g} (kg, kg m2)"
        got = f"{diagonal.min():g} to {diagonal.max():g}"
        raise StapeskitError.of(f"the diagonal of {thing}", wanted, got, where, "Check its units")
    scaled = matrix / np.sqrt(np.outer(diagonal, diagonal))
    if np.max(np.abs(scaled - scaled.T)) > 1e-6:
        step = "Check the order of its rows"
        raise StapeskitError.of(thing, "symmetric", "an asymmetric one", where, step)
    smallest = float(np.linalg.eigvalsh(scaled)[0])
    if smallest <= 1e-9:
        step = "Check units and signs (M(y, alpha) = -m z, M(y, gamma) = +m x)"
        got = f"a smallest scaled eigenvalue of {smallest:.3g}"
        raise StapeskitError.of(thing, "positive definite", got, where, step)
    if len(matrix) == len(DOF_NAMES):
        raise_all(inertia_faults(matrix, where=where))


def read_mass_csv(path: Path, dof: tuple[str, ...]) -> Array:
    """Read the numbers of a matrix (k, k): its rows are ``dof``, all six, or named in the file.

    Comma separated, or with semicolons or tabs, where a comma is a decimal comma. A first row of names of
    degrees of freedom, and such a first column, as pandas writes them, order the matrix.

    Raises
    ------
    StapeskitError
        The file is missing, binary, of another kind, not square or holds text; every wrong cell is named.
    """
    rows = _cells(path)
    names = tuple(cell.lower() for cell in rows[0][1] if cell) if rows else ()
    if not names or not set(names) <= set(DOF_NAMES):
        names = ()
    elif not set(dof) <= set(names):
        wanted = f"of the degrees of freedom {','.join(dof)}"
        raise StapeskitError.of("M.csv", wanted, ",".join(names), path.name, "Give a larger M, or --dof")
    else:
        rows = _without_names(rows[1:], names, path.name)
    faults = list[Fault]()
    values = [_numbers(cells, path.name, line, faults) for line, cells in rows]
    raise_all(faults)
    sizes = {len(names)} if names else {len(dof), len(DOF_NAMES)}
    if len(values) not in sizes or any(len(row) != len(values) for row in values):
        widths = sorted({len(row) for row in values}) or [0]
        wanted = " or ".join(f"{size} x {size}" for size in sorted(sizes))
        got = f"{len(values)} rows of {' or '.join(map(str, widths))} numbers"
        step = f"Give M in the order of --dof, {','.join(dof)}"
        raise StapeskitError.of("M.csv", wanted, got, path.name, step)
    if not names:
        return np.array(values)
    places = [names.index(name) for name in (DOF_NAMES if len(names) == len(DOF_NAMES) else dof)]
    return np.array(values)[np.ix_(places, places)]


def _without_names(
    rows: list[tuple[int, list[str]]], names: tuple[str, ...], file: str
) -> list[tuple[int, list[str]]]:
    """Return rows without the first column of names of degrees of freedom, where there is one."""
    if not all(cells[0].isalpha() for _, cells in rows):
        return rows
    beside = tuple(cells[0].lower() for _, cells in rows)
    if beside != names:
        wanted = f"in the order of its first row ({', '.join(names)})"
        raise StapeskitError.of("the first column of M.csv", wanted, list_some(beside, 6), file)
    return [(line, cells[1:]) for line, cells in rows]


def _cells(path: Path) -> list[tuple[int, list[str]]]:
    """Return the lines of a table that are not empty, by number, as cells with decimal points."""
    if not path.is_file():
        step = "Run ct2mass to make a mass.json"
        raise StapeskitError.of("--mass", "an existing mass.json or M.csv", path, "", step)
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError:
        wanted, step = "a text file of numbers or a mass.json", "Give the mass.json of ct2mass"
        raise StapeskitError.of("--mass", wanted, "a binary file", path.name, step) from None
    for mark in (";", "\t"):
        if mark in text:
            text = text.replace(",", ".").replace(mark, ",")
    lines = [[cell.strip(' "') for cell in line.split(",")] for line in text.splitlines()]
    if lines and "freq_hz" in lines[0]:
        measured = any(cell.endswith(("_re_m", "_re_rad")) for cell in lines[0])
        what = "the motion of points2dof" if measured else "a vibrometer file, which points2dof reads"
        step = f"It looks like {what}: files may be exchanged. --mass takes the mass.json of ct2mass"
        raise StapeskitError.of("M.csv", "numbers of a mass matrix", "a column freq_hz", path.name, step)
    return [(number, cells) for number, cells in enumerate(lines, 1) if any(cells)]


def _numbers(cells: list[str], file: str, line: int, faults: list[Fault]) -> list[float]:
    """Return the numbers of a row, and add the faults of its cells."""
    numbers, wanted = list[float](), "numbers separated by commas"
    step = "Write SI numbers with decimal points and commas between them, or name degrees of freedom"
    for column, cell in enumerate(cells, 1):
        try:
            numbers.append(float(cell))
        except ValueError:
            shown, where = cell and f'"{cell[:40]}"', Place(file, "row", (line,), f"column {column}")
            faults.append(Fault("M.csv", wanted, shown or "an empty cell", where, step))
    return numbers
