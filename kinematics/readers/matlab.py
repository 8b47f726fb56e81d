"""Read spectra of MATLAB and HDF5 files by the names of their variables, as File Access scripts save them.

``x`` (F, Hz) and ``y`` (points x F, complex, or ``y_re`` and ``y_im``) with the struct ``usd`` that
GetPointData returns or a text ``unit``; ``xyz`` of GetXYZCoordinates (points x 3, m); one value a beam
(``amp_x``, ``amp_y``, ``amp_z`` with ``usd_x`` ...); ``direction``, ``coherence``, ``sd``, ``n_avg``,
``points``, ``body``. All of it in the file, in one struct, or in a struct array with one element a channel.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from kinematics.readers.recording import NOISE, Recording, Row, from_parts, unknown_vector
from kinematics.readers.stated_by_user import FileFacts, direction_of
from kinematics.readers.text import plain_name
from kinematics.readers.tree import OPAQUE, read_tree
from kinematics.readers.units import LENGTHS
from stapeskit.arrays import Array
from stapeskit.faults import Fault, Place, StapeskitError, collect_faults, list_some
from stapeskit.warnings import Notice

NAMES = {
    "frequency": ("freq_hz", "f_hz", "freq", "frequency", "frequencies", "f", "x"),
    "position": ("xyz", *(f"{name}_{unit}" for name in ("xyz", "position") for unit in ("mm", "m", "um")),
                 "coordinates", "position", "positions"),
    "points": ("points", "point", "names", "name", "labels", "index"),
    "coherence": ("coh", "coherence", "gamma2"),
    "sd": ("sd",),
    "n_avg": ("n_avg", "navg", "averages"),
    "unit": ("unit", "units", "yunit"),
    "direction": ("direction", "directions", "dir"),
}  # fmt: skip
"""Names that variables may have, in any case, by what they hold."""

VALUES = ("y", "v", "amp", "vib", "fft", "frf", "h1", "h2", "value")
_VALUE = re.compile(rf"((?:{'|'.join(VALUES)})?(?:_?([xyz]))?)_?(re|im|real|imag)?")
_DOF_TEXT = re.compile(r"ptc(Plus|Minus)([XYZ])Translation")  # names of Polytec's PTCDirection
_OPAQUE_STEP = (
    "Save them as char, cell array or numbers: names = cellstr(names); unit = char(unit); y = table.y; then "
    "save again"
)
_SQUARE_STEP = "Leave a frequency out, or save a struct array with the spectrum of one point in each element"
_STEP = (
    "Name them freq_hz and y (points x frequencies, complex), or amp_x, amp_y, amp_z, with unit and xyz, in "
    "the file or in one struct, and save again; time series need --channels FILE"
)


def read(path: Path, facts: FileFacts) -> Recording:  # noqa: ARG001
    """Read a MATLAB or HDF5 file with spectra.

    Raises
    ------
    StapeskitError
        The file is damaged, or its layout is not recognised (the variables found are listed). Shapes that do
        not match and values that are not complex are with the recording.
    """
    path, notices, faults, rows = Path(path), list[str](), list[Fault](), list[Row]()
    tree = read_tree(path)
    opaque = [name for name, value in tree.items() if isinstance(value, str) and value == OPAQUE]
    unread, held = f"MATLAB strings, tables or objects ({', '.join(opaque)})", list[Variables]()
    with collect_faults(faults):
        held = _variables_of({name: one for name, one in tree.items() if name not in opaque}, path.name)
    for one in held:
        rows += one.rows(faults)
    if opaque and (faults or not all(row.unit for row in rows)):
        faults.insert(0, Fault("the variables", "of char, cell or number arrays", unread, "", _OPAQUE_STEP))
    notices += [f"{unread} were not read. {_OPAQUE_STEP}."] if opaque else []
    if left_out := list_some((name for one in held for name in one.unknown()), 12):
        notices.append(f"{left_out} have a value a frequency, but are no names of values: left out.")
    if square := list_some((name for one in held for name in one.square()), 6):
        notices.append(f"{square} may hold three points in rows or in columns: taken as rows, as the values.")
    return Recording(
        path.name,
        tuple(rows),
        tuple(Notice("file_read", f"{path.name}: {text}") for text in notices),
        f"variables of {path.name}",
        length_stated=all(one.length_unit or not one.name("position") for one in held),
        faults=tuple(faults),
    )


def _variables_of(tree: Mapping[str, Any], file: str) -> list[Variables]:
    """Return the variables of a file, of its one struct, or of each element of its one struct array."""
    low = {name.lower(): value for name, value in tree.items()}
    if len(low) < len(tree):
        got, want = list_some(tree, 20), "different in more than their case"
        raise StapeskitError.of("the names of the variables", want, got, file, "Rename one of them")
    if (whole := Variables(low, file)).name("frequency"):
        return [whole]
    structs = {name: elements for name, value in low.items() if (elements := _structs_of(value))}
    for name, elements in structs.items() if len(structs) == 1 else ():
        found = [
            Variables(
                {**low, **{key.lower(): one for key, one in fields.items()}},
                f"{file}, {name}",
                str(number) if len(elements) > 1 else "",
            )
            for number, fields in enumerate(elements, 1)
        ]
        if all(one.name("frequency") for one in found):
            return found
    sizes = {name: " x ".join(map(str, getattr(value, "shape", ()))) for name, value in tree.items()}
    listed = list_some((f"{name} ({size})" if size else name for name, size in sizes.items()), 12)
    raise StapeskitError.of(file, "of a known layout", f"the variables {listed or 'none'}", "", _STEP)


def _structs_of(value: Any) -> list[Mapping[str, Any]]:
    """Return a struct, or the elements of a struct array; nothing of other variables."""
    listed = [value] if isinstance(value, Mapping) else value
    found = list(listed) if isinstance(listed, list | np.ndarray) and np.ndim(listed) == 1 else []
    return found if all(isinstance(one, Mapping) for one in found) else []


@dataclass(frozen=True)
class Variables:
    """Variables by their names in small letters, of the file or of a struct before those around it.

    ``element`` is the number of an element of a struct array: the name of its point where it holds none.
    """

    held: Mapping[str, Any]
    file: str
    element: str = ""

    def name(self, role: str, axis: str = "") -> str:
        """Return the first name of a role (a key of `NAMES`), for one beam before all; empty without one."""
        names = [*(f"{name}_{axis}" for name in NAMES[role]), *NAMES[role]]
        return next((name for name in names if name in self.held), "")

    def refuse(self, thing: str, expected: str, got: object, step: str = "Correct and save it") -> NoReturn:
        """Refuse a variable."""
        got = " x ".join(map(str, got)) if isinstance(got, tuple) else got
        raise StapeskitError.of(thing, expected, got, self.file, step)

    def numbers(self, name: str) -> NDArray[Any]:
        """Return an array of numbers."""
        value = np.asarray(self.held[name])
        if value.dtype.kind not in "fciub" or value.size == 0:
            self.refuse(f"the variable {name}", "an array of numbers", "something else")
        return value

    def shaped(self, name: str, columns: int, rows: int = 0) -> NDArray[Any]:
        """Return an array of points x columns, in either order, as (point, column).

        Where the number of points, ``rows``, is known, one row is that of all points; where it is not, a
        square matrix is refused, since nothing says which of the two orders it has.
        """
        value = np.atleast_2d(self.numbers(name))
        if not rows and value.shape == (columns, columns) and not np.array_equal(value, value.T):
            want = "of another number of points than of frequencies, which shows where its points are"
            self.refuse(f"the variable {name}", want, value.shape, _SQUARE_STEP)
        value = value.T if value.shape[1] != columns else value
        if value.ndim != 2 or value.shape[1] != columns or (rows and len(value) not in (1, rows)):
            self.refuse(f"the variable {name}", f"{rows or 'points'} x {columns}", np.shape(self.held[name]))
        return np.broadcast_to(value, (rows, columns)) if rows else value

    def texts(self, name: str, count: int) -> list[str]:
        """Return the texts of a variable, one a row; one is that of all rows."""
        value = self.held.get(name, "")
        values = [value] if isinstance(value, str) else np.asarray(value).reshape(-1).tolist()
        texts = [plain_name(str(one)) for one in values]
        if len(texts) not in (1, count):
            self.refuse(name, f"{count} texts, one a row", len(texts))
        return texts * (count // len(texts))

    def text(self, *names: str) -> str:
        """Return the first text of these names that is there; empty without one."""
        found = (self.held.get(name) for name in names)
        return next((one.strip() for one in found if isinstance(one, str) and one.strip()), "")

    def usd(self, axis: str = "") -> Mapping[str, Any]:
        """Return the struct that describes values, for one beam before all; an empty one without it."""
        found = (self.held.get(name) for name in (f"usd_{axis}", "usd"))
        return next((one for one in found if isinstance(one, Mapping)), {})

    @property
    def length_unit(self) -> str:
        """The unit at the end of the name of the positions, or beside them; empty without one."""
        name = self.name("position")
        stated, ending = self.text(f"{name} unit"), name.rpartition("_")[2]
        if not stated:
            return ending if ending in LENGTHS else ""
        if stated not in LENGTHS or (ending in LENGTHS and ending != stated):
            expected = ending if ending in LENGTHS else f"one of {', '.join(LENGTHS)}"
            step = f"Save {name} with that unit, or without one and give --length-unit"
            raise StapeskitError.of(f"the unit of {name}", expected, stated, self.file, step)
        return stated

    def rows(self, faults: list[Fault]) -> list[Row]:
        """Read every beam at every point; what is wrong with the variables is added to the faults."""
        rows = list[Row]()
        beams = self._beams()
        for (_, axis), parts in beams.items():
            with collect_faults(faults):
                rows += self._rows_of(parts, axis)
        if not beams:
            want, got = f"with spectra named {', '.join(VALUES)}", f"the variables {list_some(self.held, 12)}"
            faults.append(Fault(self.file, want, got, "", _STEP))
        return rows

    def _beams(self) -> dict[tuple[str, str], dict[str, str]]:
        """Return the names of the parts of values, by what they are and the axis."""
        beams: dict[tuple[str, str], dict[str, str]] = {}
        for name, value in self.held.items():
            match = _VALUE.fullmatch(name)
            if match and name not in (self.name("frequency"), "x", "z") and not isinstance(value, Mapping):
                beams.setdefault((match[1], match[2] or ""), {})[(match[3] or "")[:2]] = name
        return beams

    def unknown(self) -> list[str]:
        """Return the names of arrays with one value a frequency that are not read."""
        lines = np.size(self.held[self.name("frequency")])
        read = {name for parts in self._beams().values() for name in parts.values()}
        read |= {
            f"{name}{axis}" for names in NAMES.values() for name in names for axis in ("", "_x", "_y", "_z")
        }
        arrays = [(name, one) for name, one in self.held.items() if isinstance(one, np.ndarray)]
        sized = [
            name for name, one in arrays if one.dtype.kind in "fciu" and lines > 1 and lines in one.shape
        ]
        return [name for name in sized if name not in read]

    def square(self) -> list[str]:
        """Return the names of positions and directions of three points, which may be written either way."""
        names = (self.name(role) for role in ("position", "direction"))
        return [name for name in names if np.shape(self.held.get(name, 0)) == (3, 3)]

    def _rows_of(self, parts: Mapping[str, str], axis: str) -> list[Row]:
        """Return one row for every point of a beam, whose real and imaginary ``parts`` may be apart."""
        source, usd, lines = next(iter(parts.values())), self.usd(axis), self.name("frequency")
        freq = self.numbers(lines).reshape(-1).astype(float)
        stated = [one["XUnit"] for one in map(self.usd, ("", *"xyz")) if np.size(one.get("XUnit", []))]
        labels = [*(str(label).strip() for label in stated), self.text(f"{lines} unit")]
        labels += ["Hz"] if lines.endswith("_hz") else []
        freq_unit = " and ".join(dict.fromkeys(filter(None, labels)))
        if np.any(np.asarray(usd.get("PowerSignal", 0)) == 1):
            step = "Export the FFT or the FRF: an auto or cross power has no phase of its own"
            self.refuse(source, "an amplitude spectrum", "a power", step)
        value, other = (self.shaped(parts.get(part, source), len(freq)) for part in ("re", "im"))
        if value.shape != other.shape or ({"re", "im"} - set(parts) and not np.iscomplexobj(value)):
            want, step = "complex, or of two parts", "Export Real & Imag.: without phase there is no motion"
            self.refuse(f"the variable {source}", want, "real numbers alone", step)
        value = value if np.iscomplexobj(value) else from_parts(value, np.real(other))
        count = len(value)
        names = self.texts(self.name("points"), count)
        if not any(names) or (count > 1 and len(set(names)) == 1):  # one text for all is a title
            names = [self.element] if self.element and count == 1 else [str(k) for k in range(1, count + 1)]
        bodies, places = self.texts("body", count), np.full((count, 3), np.nan)
        if count == 3 and self.square() and np.shape(self.held[source])[0] != 3:
            want = "points x frequencies where there are three points, as their positions and directions"
            self.refuse(f"the variable {source}", want, np.shape(self.held[source]), "Transpose it")
        if name := self.name("position"):
            places = self.shaped(name, 3, count).astype(float) * LENGTHS[self.length_unit or "m"]
        noise = {}
        for role in NOISE:
            if name := self.name(role, axis):
                single = np.size(self.held[name]) == 1
                known = self.numbers(name).reshape(1, 1) if single else self.shaped(name, len(freq), count)
                noise[role] = np.broadcast_to(np.real(known).astype(float), value.shape)
        unit = self.text(f"{source} unit", self.name("unit")) or str(usd.get("YUnit", ""))
        directions = self._directions(axis, usd, count)
        return [
            Row(
                names[k], freq, value[k], f"{unit} {self.text('amplitude')}".strip(), bodies[k],
                position_m=places[k], direction=directions[k], source=source, freq_unit=freq_unit,
                where=Place(f"{self.file}, {source}", "row", (int(self.element or k + 1),)),
                **{role: matrix[k] for role, matrix in noise.items()},
            )
            for k in range(count)
        ]  # fmt: skip

    def _directions(self, axis: str, usd: Mapping[str, Any], count: int) -> Array:
        """Return the direction of the beam at every point, (count, 3), NaN where it is not stated."""
        name = self.name("direction")
        stated = axis or self.held.get(name, "")
        if not isinstance(stated, str):
            if np.asarray(stated).dtype.kind in "fiu":
                return self.shaped(name, 3, count).astype(float)
            return np.array([direction_of(text, self.file, name) for text in self.texts(name, count)])
        dofs = usd.get("ResponseDOFs", [])  # +-1, 2, 3 for +-x, y, z, or texts
        listed = [dofs] if isinstance(dofs, Mapping) else list(dofs) if np.ndim(dofs) == 1 else []
        codes = {
            str(one["Direction"]): one["Direction"] for one in listed if np.size(one.get("Direction", []))
        }
        if len(codes) > 1 and not stated:
            step = "Save each channel apart: amp_x with usd_x, amp_y with usd_y, ..."
            self.refuse("the ResponseDOFs of usd", "of one direction", ", ".join(codes), step)
        code = 0 if stated else next(iter(codes.values()), 0)
        if isinstance(code, str) and (text := _DOF_TEXT.fullmatch(code)):
            stated = ("-" if text[1] == "Minus" else "") + text[2].lower()
        elif np.size(code) == 1 and np.asarray(code).dtype.kind in "fiu" and abs(code) in (1, 2, 3):
            stated = ("-" if code < 0 else "") + "xyz"[int(abs(code)) - 1]
        return np.tile(direction_of(stated, self.file, name) if stated else unknown_vector(), (count, 1))
