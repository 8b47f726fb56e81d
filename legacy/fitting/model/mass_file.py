"""The mass matrix from a file: mass.json, or a plain square CSV in SI."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from legacy.fitting.errors import FittingError
from legacy.fitting.model.inertia import check_mass
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.faults import Fault, Place, list_some, raise_all
from legacy.stapeskit.records.mass_record import MassMatrix, MassRecord, read_mass_record
from legacy.stapeskit.spatial import DOF_NAMES, inertia_faults


def read_mass(path: Path, dof: tuple[str, ...]) -> tuple[MassMatrix | Array, MassRecord | None]:
    """Read a mass matrix about the footplate centre in footplate axes.

    Parameters
    ----------
    path : Path
        ``*.json``: a mass.json. Anything else: square, no header, SI, in the order of ``dof``, or of all six
        degrees of freedom; comma separated, or with semicolons or tabs, where a comma is a decimal comma.
    dof : tuple of str
        Chosen degrees of freedom.

    Returns
    -------
    mass : MassMatrix or ndarray, (n, n) or (6, 6)
    record : MassRecord or None
        The whole mass.json.

    Raises
    ------
    FittingError
        The CSV is missing, is not square, holds text, has another size than ``dof``, is no mass matrix, or,
        of six degrees of freedom, that of no rigid body.
    KinematicsError
        The mass.json is at fault.
    """
    path = Path(path)
    if path.suffix.lower() == ".json":
        record = read_mass_record(path)
        return record.mass_matrix, record
    matrix = _read_csv(path, dof)
    check_mass(matrix, path.name)
    if len(matrix) != len(dof):
        raise_all(FittingError, inertia_faults(matrix, where=path.name))
    return matrix, None


def _read_csv(path: Path, dof: tuple[str, ...]) -> Array:
    if not path.is_file():
        raise FittingError.of(
            "{mass}", "an existing mass.json or M.csv", path, next_step="Run ct2mass to make a mass.json"
        )
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as fault:
        raise FittingError.of(
            "{mass}",
            "a text file of numbers or a mass.json",
            "a binary file",
            path.name,
            "Give the mass.json of ct2mass, or write M as comma separated text",
        ) from fault
    for mark in (";", "\t"):
        if mark in text:
            text = text.replace(",", ".").replace(mark, ",")
    values, faults = list[list[float]](), list[Fault]()
    for line, words in enumerate(text.splitlines(), 1):
        if words.strip():
            if not values:
                _refuse_header(words, Place(path.name, "row", (line,)))
            numbers, wrong = _row(words, line, path.name)
            values.append(numbers)
            faults += wrong
    raise_all(FittingError, faults)
    n = len(dof)
    if len(values) not in (n, len(DOF_NAMES)) or any(len(row) != len(values) for row in values):
        widths = sorted({len(row) for row in values}) or [0]
        raise FittingError.of(
            "M.csv",
            f"{n} x {n} for {{dof}} {','.join(dof)}, or 6 x 6",
            f"{len(values)} rows of {' or '.join(map(str, widths))} numbers",
            path.name,
            "Give M in the order of {dof}, or change {dof}",
        )
    return np.array(values)


def _refuse_header(words: str, place: Place) -> None:
    """Refuse a first row without numbers; dof.csv has one, and is soon taken for M."""
    cells = [cell.strip().strip('"') for cell in words.split(",")]
    if not all(cell[:1].isalpha() for cell in cells):
        return
    step = "Remove the header"
    if "freq_hz" in cells:
        step = "It looks like the motion of points2dof: give that first, and mass.json or M.csv with {mass}"
    raise FittingError.of(
        "M.csv", "numbers separated by commas, without a header", list_some(cells, 6), place, step
    )


def _row(words: str, line: int, name: str) -> tuple[list[float], list[Fault]]:
    """Return the numbers of a row and the faults of its cells."""
    numbers, faults = [], []
    for column, cell in enumerate(words.split(","), 1):
        try:
            numbers.append(float(cell))
        except ValueError:
            shown = cell.strip() if len(cell) <= 40 else f"{cell.strip()[:37]}..."
            faults.append(
                Fault(
                    "M.csv",
                    "numbers separated by commas, without a header",
                    f'"{shown}"' if shown else "an empty cell",
                    Place(name, "row", (line,), f"column {column}"),
                    "Write SI numbers with decimal points and commas between them",
                )
            )
    return numbers, faults
