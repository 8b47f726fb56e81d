"""The mass matrix of a fit: from a result of ct2mass, a mass.json, or a plain matrix in SI (M.csv)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from stapeskit.arrays import Array
from stapeskit.faults import Fault, Place, StapeskitError, list_some, raise_all
from stapeskit.records.mass_matrix import MassMatrix
from stapeskit.spatial import DOF_NAMES, inertia_faults

_SMALLEST, _LARGEST = 1e-30, 1e6  # kg, kg m2: of no body that is measured here


@dataclass(frozen=True)
class Inertia:
    """A mass matrix about the footplate centre in footplate axes."""

    dof: tuple[str, ...]  # its degrees of freedom: those of the model, or all six
    matrix: Array  # (k, k): SI
    # (10, 10): covariance of its ten inertial parameters by source; only where it has all six degrees of
    # freedom
    contributions: Mapping[str, Array] = field(default_factory=dict)

    @property
    def complete(self) -> bool:
        """Whether it has all six degrees of freedom."""
        return self.dof == DOF_NAMES

    def block(self, dof: tuple[str, ...]) -> Array:
        """Return the matrix of some of its degrees of freedom, (n, n)."""
        places = [self.dof.index(name) for name in dof]
        return self.matrix[np.ix_(places, places)]


def inertia_of(mass: MassMatrix | ArrayLike, dof: tuple[str, ...]) -> Inertia:
    """Take a mass in either form and check it against the degrees of freedom of the model.

    Parameters
    ----------
    mass : MassMatrix or array_like
        About the footplate centre in footplate axes; an array (SI) is (n, n) in the order of ``dof``, or (6,
        6).
    dof : tuple of str, (n,)

    Raises
    ------
    StapeskitError
        Its shape does not fit, it is about another point or in other axes, or no body can have it.
    """
    if isinstance(mass, MassMatrix):
        if (mass.about, mass.axes) != ("footplate_centre", "footplate"):
            wanted, step = (
                "about footplate_centre in footplate axes",
                "Take the block mass_matrix of mass.json",
            )
            got = f"about {mass.about} in {mass.axes} axes"
            raise StapeskitError.of("the mass matrix", wanted, got, "", step)
        return Inertia(DOF_NAMES, mass.matrix, mass.contributions)
    matrix = np.asarray(mass, dtype=float)
    if matrix.shape not in ((len(dof),) * 2, (6, 6)):
        shape = " x ".join(str(size) for size in matrix.shape) or "a single number"
        wanted = f"{len(dof)} x {len(dof)} for --dof {','.join(dof)}, or 6 x 6"
        raise StapeskitError.of("the mass matrix", wanted, shape, "", "Give M in the order of --dof")
    check_mass(matrix)
    return Inertia(dof if len(matrix) == len(dof) else DOF_NAMES, matrix)


def check_mass(matrix: Array, where: str = "") -> None:
    """Refuse a matrix that is not finite, symmetric, positive definite and of a size that bodies have.

    Raises
    ------
    StapeskitError
        Any of these, or, of six degrees of freedom, a matrix that no rigid body has.
    """
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
    if len(matrix) == 6:
        raise_all(inertia_faults(matrix, where=where))


def with_tensor_signs(matrix: Array, dof: tuple[str, ...], sign: str) -> Array:
    """Return a plain mass matrix with elements of the inertia tensor, whatever sign it was written with."""
    turned = np.array([name in DOF_NAMES[3:] for name in (dof if len(matrix) == len(dof) else DOF_NAMES)])
    flipped = np.outer(turned, turned) & ~np.eye(len(matrix), dtype=bool) & (sign == "positive")
    return np.where(flipped, -matrix, matrix)


def has_products(matrix: Array, dof: tuple[str, ...]) -> bool:
    """Return whether a plain mass matrix has products of inertia, whose sign is a convention."""
    return bool(np.any(with_tensor_signs(matrix, dof, "positive") != matrix))


def read_mass_csv(path: Path, dof: tuple[str, ...]) -> Array:
    """Read a square mass matrix, SI: its rows are ``dof``, all six degrees of freedom, or named in the file.

    Comma separated, or with semicolons or tabs, where a comma is a decimal comma. A first row of names of
    degrees of freedom, and such a first column, as pandas writes them, order the matrix.

    Raises
    ------
    StapeskitError
        The file is missing, binary, not square, holds text, or is no mass matrix; every wrong cell is named.
    """
    path = Path(path)
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
    sizes = {len(names)} if names else {len(dof), 6}
    if len(values) not in sizes or any(len(row) != len(values) for row in values):
        widths = sorted({len(row) for row in values}) or [0]
        wanted = " or ".join(f"{size} x {size}" for size in sorted(sizes))
        got = f"{len(values)} rows of {' or '.join(map(str, widths))} numbers"
        step = f"Give M in the order of --dof, {','.join(dof)}"
        raise StapeskitError.of("M.csv", wanted, got, path.name, step)
    matrix = np.array(values)
    if names:
        places = [names.index(name) for name in (DOF_NAMES if len(names) == len(DOF_NAMES) else dof)]
        matrix = matrix[np.ix_(places, places)]
    check_mass(matrix, path.name)
    return matrix


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
    if "freq_hz" in text:
        step = "It looks like the motion of points2dof: give that first, and the mass with --mass"
        raise StapeskitError.of("M.csv", "numbers of a mass matrix", "a column freq_hz", path.name, step)
    for mark in (";", "\t"):
        if mark in text:
            text = text.replace(",", ".").replace(mark, ",")
    lines = [[cell.strip(' "') for cell in line.split(",")] for line in text.splitlines()]
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
