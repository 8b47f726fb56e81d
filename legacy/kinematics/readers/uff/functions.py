"""Dataset 58 of a universal file: one function at one point and direction, its header and its numbers."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from legacy.kinematics.errors import KinematicsError
from legacy.kinematics.readers.recording import from_parts
from legacy.kinematics.readers.text import lines_of, shown
from legacy.kinematics.readers.uff.datasets import CUT, Dataset, data_form
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.faults import Fault, collect_faults, raise_all

# Function types, number of header records and widths of record 6: SDRC universal file format, dataset 58.
TIME, AUTO, CROSS, FRF, TRANSMISSIBILITY, COHERENCE, PSD, SPECTRUM = 1, 2, 3, 4, 5, 6, 9, 12
KINDS = {
    0: "function of unknown type",
    TIME: "time response",
    AUTO: "auto spectrum",
    CROSS: "cross spectrum",
    FRF: "frequency response function",
    TRANSMISSIBILITY: "transmissibility",
    COHERENCE: "coherence",
    PSD: "power spectral density",
    10: "energy spectral density",
    SPECTRUM: "spectrum",
    26: "multiple coherence",
}
# Records before the data, and widths of the cells of record 6 (dataset 58).
_HEADER_LINES = 11
_WIDTHS = (5, 10, 5, 10, 11, 10, 4, 11, 10, 4)
# Characters of a number, more than the 20 of the widest column: an array of words is as wide as its longest.
_LONGEST = 64


@dataclass(frozen=True)
class Axis:
    """What one axis holds: data type of the format, exponents of length and force, label, unit."""

    kind: int
    length: int
    force: int
    label: str
    unit: str


@dataclass(frozen=True)
class Function:
    """One function.

    Attributes
    ----------
    kind : int
        Function type of the format (4 frequency response, 6 coherence, 12 spectrum, ...).
    channel, version, load_case : int
        Identification, sequence and load case numbers.
    entity, node, direction
        Response: name, number, and +-1..3 translation, +-4..6 rotation, 0 scalar.
    reference_node, reference_direction
        Of the reference.
    x : ndarray, (n,)
    y : ndarray, (n,), complex
    real : bool
        Whether the file holds real numbers.
    place : int
        Which dataset of the file.
    names : tuple of str
        The first two lines of identification.
    """

    kind: int
    channel: int
    version: int
    load_case: int
    entity: str
    node: int
    direction: int
    reference_node: int
    reference_direction: int
    x: Array
    y: NDArray[np.complex128]
    real: bool
    abscissa: Axis
    ordinate: Axis
    denominator: Axis
    place: int
    names: tuple[str, str] = ("", "")

    @property
    def kind_name(self) -> str:
        """Name of the function type."""
        return KINDS.get(self.kind, f"function of type {self.kind}")


def only_alike(functions: Iterable[Function], other: Function) -> Function | None:
    """Return the function with the abscissa of another one; None where there is none, or several."""
    alike = [function for function in functions if same_abscissa(function, other)]
    return alike[0] if len(alike) == 1 else None


def same_abscissa(first: Function, second: Function) -> bool:
    """Return whether two functions have the same abscissa, to the digits that files have."""
    return len(first.x) == len(second.x) and np.allclose(first.x, second.x)


def read_function(dataset: Dataset, file: str) -> Function:
    """Read a dataset 58 or 58b.

    Raises
    ------
    KinematicsError
        The header is not as the format says, or the values are fewer than it says or no numbers.
    """
    head = dataset.lines
    if len(head) < 11:
        where = f"{file}, dataset {dataset.place}"
        raise KinematicsError.of("the header of a function", "of 11 lines", f"{len(head)} lines", where, CUT)
    faults: list[Fault] = []
    identity, spacing = None, (0.0, 1.0)
    kind, count, even = 0, 0, False
    x, y = np.empty(0), np.empty(0, dtype=complex)
    with collect_faults(faults):
        identity = _identity(head[5], dataset.at(file, 6))
    with collect_faults(faults):
        kind, count, even = data_form(head, dataset.at(file, 7))
        if even:
            with collect_faults(faults):
                spacing = _spacing(head[6], dataset.at(file, 7))
        x, y = _values(dataset, kind, count, even, file)
    raise_all(KinematicsError, faults)
    if even:
        with np.errstate(over="ignore"):
            x = np.asarray(spacing[0] + spacing[1] * np.arange(count), dtype=float)
    abscissa, ordinate, denominator = (_axis(line) for line in head[7:10])
    return Function(
        *identity,
        x,
        y,
        kind in (2, 4),
        abscissa,
        ordinate,
        denominator,
        dataset.place,
        names=(head[0].strip(), head[1].strip()),
    )


def _identity(record: str, where: str) -> tuple[int, int, int, int, str, int, int, int, int]:
    """Read record 6, format 2(I5,I10),2(1X,10A1,I10,I4), without the name of the reference."""
    ends = np.cumsum(_WIDTHS)
    cells = [record[end - width : end].strip() for end, width in zip(ends, _WIDTHS, strict=True)]
    if not all(_is_whole(cell) for place, cell in enumerate(cells) if place not in (4, 7)):
        # A name wider or narrower than its ten columns shifts the rest.
        loose = re.fullmatch(
            r"\s*(\d+)\s+(-?\d+)\s+(-?\d+)\s+(-?\d+)\s+(\S.*?)\s+(-?\d+)\s+(-?\d+)\s+(\S.*?)\s+(-?\d+)\s+(-?\d+)\s*",
            record,
        )
        if loose is None:
            step = "Export it again"
            raise KinematicsError.of(
                "record 6 of a function", "function type, node and direction", shown(record), where, step
            )
        cells = list(loose.groups())
    del cells[7]
    numbers = [cell if place == 4 else _parse_integer(cell) for place, cell in enumerate(cells)]
    return tuple(numbers)  # type: ignore[return-value]


def _is_whole(cell: str) -> bool:
    return re.fullmatch(r"[+-]?\d*", cell) is not None and cell not in ("+", "-")


def _parse_integer(cell: str) -> int:
    return int(cell) if cell else 0


def _axis(record: str) -> Axis:
    """Read records 8 to 11: format I10,3I5,2(1X,20A1)."""
    cells = [record[0:10], record[10:15], record[15:20], record[20:25]]
    numbers = [_parse_integer(cell.strip()) if _is_whole(cell.strip()) else 0 for cell in cells]
    label, unit = record[26:46].strip(), record[47:67].strip()
    return Axis(numbers[0], numbers[1], numbers[2], label, unit)


def _spacing(record: str, where: str) -> tuple[float, float]:
    """Read first value and increment of an even abscissa from record 7: format 3I10,3E13.5."""
    cells = [record[30:43], record[43:56]]
    try:
        first, step = (fortran_number(cell) for cell in cells)
    except ValueError:
        try:
            first, step = (fortran_number(cell) for cell in record.split()[3:5])
        except ValueError as fault:
            raise KinematicsError.of(
                "the abscissa of a function", "a first value and a step", shown(record), where
            ) from fault
    if not (np.isfinite(first) and np.isfinite(step)) or step <= 0.0:
        raise KinematicsError.of(
            "the step of the abscissa", "positive", f"{step:g}", where, "Export it again"
        )
    return first, step


def fortran_number(text: str) -> float:
    """Read a Fortran number: D for E, and exponents of three digits without the letter."""
    text = text.strip().replace("D", "E").replace("d", "e")
    if "_" in text:
        raise ValueError(text)
    try:
        return float(text)
    except ValueError:
        return float(re.sub(r"([\d.])([+-]\d{3})$", r"\1E\2", text))


def _values(
    dataset: Dataset, kind: int, count: int, even: bool, file: str
) -> tuple[Array, NDArray[np.complex128]]:
    """Return the abscissa (empty when even) and the ordinate."""
    parts = 2 if kind in (5, 6) else 1
    if dataset.binary:
        rows = _binary(dataset, kind, count, even, parts)
    else:
        rows = _text(dataset, kind, count, even, parts, file)
    x = np.empty(0) if even else rows[:, 0]
    columns = rows if even else rows[:, 1:]
    y = from_parts(columns[:, 0], columns[:, 1] if parts == 2 else 0.0)
    return np.ascontiguousarray(x), y


def _binary(dataset: Dataset, kind: int, count: int, even: bool, parts: int) -> Array:
    mark = ">" if dataset.big_endian else "<"
    value = f"{mark}f{4 if kind in (2, 5) else 8}"
    if even:
        numbers = np.frombuffer(dataset.data, value, count * parts)
        with np.errstate(invalid="ignore"):
            return numbers.astype(float).reshape(count, parts)
    wide = value.endswith("8") and len(dataset.data) >= count * 8 * (parts + 1)
    layout = np.dtype([("x", f"{mark}f8" if wide else f"{mark}f4"), ("y", value, (parts,))])
    rows = np.frombuffer(dataset.data, layout, count)
    with np.errstate(invalid="ignore"):
        return np.column_stack([rows["x"].astype(float), rows["y"].astype(float)])


def _text(dataset: Dataset, kind: int, count: int, even: bool, parts: int, file: str) -> Array:
    columns = parts + (0 if even else 1)
    wanted = count * columns
    formats = _formats(kind, even)
    words = dataset.data.replace(b"D", b"E").split()
    end, numbers = len(words), np.empty(0)
    # Values that the bytes cannot hold are refused before anything of their size is made.
    if end >= wanted and b"_" not in dataset.data and max(map(len, words[:wanted]), default=0) <= _LONGEST:
        try:
            numbers = np.array(words[:wanted], dtype=np.bytes_).astype(float)
        except ValueError:
            end = 0
    if numbers.size < wanted:
        numbers = np.array(_by_line(dataset, formats, file))
        end = numbers.size
    # Some writers fill the last line with zeros.
    if end < wanted or end - wanted >= len(formats):
        got = f"{end // columns}"
        where = f"{file}, dataset {dataset.place}"
        raise KinematicsError.of("a function", f"of {count} values, as it says", got, where, CUT)
    return np.asarray(numbers[:wanted], dtype=float).reshape(count, columns)


def _formats(kind: int, even: bool) -> tuple[int, ...]:
    """Return the widths of the columns of one line."""
    if kind in (2, 5):
        return (13,) * 6
    if even:
        return (20,) * 4
    return (13, 20, 13, 20) if kind == 4 else (13, 20, 20)


def _by_line(dataset: Dataset, widths: tuple[int, ...], file: str) -> list[float]:
    """Read numbers line by line: by words where a line has as many as columns, else by the columns.

    Raises
    ------
    KinematicsError
        Every cell that is no number, by line and column.
    """
    ends = np.cumsum(widths)
    numbers: list[float] = []
    faults: list[Fault] = []
    for row, line in enumerate(lines_of(dataset.data.decode("latin-1")), _HEADER_LINES + 1):
        cells = line.split()
        if len(cells) != len(widths) and len(line.rstrip()) > ends[-1]:
            got, most = f"{len(line.rstrip())} characters", f"at most {ends[-1]} characters long"
            faults.append(Fault("a line of a function", most, got, dataset.at(file, row), "Export it again"))
        elif len(cells) != len(widths):
            cells = [line[end - width : end] for end, width in zip(ends, widths, strict=True)]
        for column, cell in enumerate(cells, 1):
            if not cell.strip():
                continue
            try:
                numbers.append(fortran_number(cell))
            except ValueError:
                where = f"{dataset.at(file, row)}, column {column}"
                faults.append(
                    Fault("a value of a function", "a number", shown(cell), where, "Export it again")
                )
    raise_all(KinematicsError, faults)
    return numbers
