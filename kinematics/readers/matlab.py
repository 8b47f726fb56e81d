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

from kinematics.readers.facts import FileFacts, direction_of
from kinematics.readers.gather import from_parts, recording_of
from kinematics.readers.recording import Recording, Row, unknown_vector
from kinematics.readers.text import plain_name
from kinematics.readers.tree import OPAQUE, read_tree
from kinematics.readers.units import HERTZ, LENGTHS
from stapeskit.arrays import Array
from stapeskit.faults import Fault, Place, StapeskitError, collect_faults, list_some, raise_all
from stapeskit.warnings import Notice

NAMES = {
    "frequency": ("freq_hz", "freq", "frequency", "frequencies", "f", "f_hz", "x"),
    "position": ("xyz", "xyz_mm", "xyz_m", "xyz_um", "coordinates", "position", "positions", "position_mm"),
    "points": ("points", "point", "names", "name", "labels", "index"),
    "coherence": ("coh", "coherence", "gamma2"),
    "sd": ("sd",),
    "n_avg": ("n_avg", "navg", "averages"),
    "unit": ("unit", "units", "yunit"),
    "direction": ("direction", "directions", "dir"),
}
"""Names that variables may have, in any case, by what they hold."""

VALUES = ("y", "v", "amp", "vib", "fft", "frf", "h1", "h2", "value")
_VALUE = re.compile(rf"((?:{'|'.join(VALUES)})?(?:_?([xyz]))?)_?(re|im|real|imag)?")
_DESCRIPTIONS = ("usd", "usd_x", "usd_y", "usd_z")
_DOF_TEXT = re.compile(r"ptc(Plus|Minus)([XYZ])Translation")  # names of Polytec's PTCDirection
_OPAQUE_STEP = (
    "Save them as char, cell array or numbers: names = cellstr(names); unit = char(unit); y = table.y; then "
    "save again"
)
_STEP = (
    "Name them freq_hz and y (points x frequencies, complex), or amp_x, amp_y, amp_z, with unit and xyz, in "
    "the file or in one struct, and save again; time series need --channels FILE"
)


def read(path: Path, facts: FileFacts) -> Recording:  # noqa: ARG001
    """Read a MATLAB or HDF5 file with spectra.

    Raises
    ------
    StapeskitError
        The file is damaged, its layout is not recognised (the variables found are listed), shapes do not
        match, or values are not complex; as `kinematics.readers.gather.recording_of`.
    """
    path, notices = Path(path), list[Notice]()
    tree = read_tree(path)
    opaque = [name for name, value in tree.items() if isinstance(value, str) and value == OPAQUE]
    unread = f"MATLAB strings, tables or objects ({', '.join(opaque)})"
    if opaque:
        notices.append(Notice("file_read", f"{path.name}: {unread} were not read. {_OPAQUE_STEP}."))
    try:
        held = _variables_of({name: one for name, one in tree.items() if name not in opaque}, path.name)
        if unknown := list_some((name for one in held for name in one.unknown()), 12):
            text = f"{path.name}: {unknown} have a value a frequency, but are no names of values: left out."
            notices.append(Notice("file_read", text))
        if square := list_some((name for one in held for name in one.square()), 6):
            text = f"{path.name}: {square} have as many rows as columns: their rows were taken as points."
            notices.append(Notice("file_read", text))
        return recording_of(
            path.name,
            [row for one in held for row in one.rows()],
            "Keep one of the signals, and save each excitation to a file of its own",
            notices=notices,
            statement=f"variables of {path.name}",
            length_stated=all(one.length_unit or not one.name("position") for one in held),
        )
    except StapeskitError as error:
        want = "of char, cell or number arrays"
        first = [Fault("the variables", want, unread, path.name, _OPAQUE_STEP)] if opaque else []
        raise StapeskitError(*first, *error.faults) from None


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

        Where the number of points, ``rows``, is known, one row is that of all points.
        """
        value = np.atleast_2d(self.numbers(name))
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

    @property
    def length_unit(self) -> str:
        """The unit at the end of the name of the positions; empty without one."""
        ending = self.name("position").rpartition("_")[2]
        return ending if ending in LENGTHS else ""

    def rows(self) -> list[Row]:
        """Read every beam at every point; all faults of the variables together."""
        freq = self.numbers(self.name("frequency")).reshape(-1).astype(float)
        described = [one for name in _DESCRIPTIONS if isinstance(one := self.held.get(name), Mapping)]
        stated = (str(one["XUnit"]).strip() for one in described if np.size(one.get("XUnit", [])))
        unit = next(filter(None, stated), "Hz")
        if unit.lower() not in HERTZ:
            self.refuse("the unit of the frequencies (XUnit)", "Hz, kHz or MHz", unit)
        freq = freq * HERTZ[unit.lower()]
        beams = self._beams()
        if not beams:
            want, got = f"with spectra named {', '.join(VALUES)}", f"the variables {list_some(self.held, 12)}"
            raise StapeskitError.of(self.file, want, got, "", _STEP)
        faults, rows = list[Fault](), list[Row]()
        for (_, axis), parts in beams.items():
            with collect_faults(faults):
                rows += self._rows_of(parts, axis, freq)
        raise_all(faults)
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
        roles = {name for names in NAMES.values() for name in names}
        read = {name for parts in self._beams().values() for name in parts.values()}
        read |= roles | {f"{name}_{axis}" for name in roles for axis in "xyz"}
        arrays = {name: one for name, one in self.held.items() if isinstance(one, np.ndarray)}
        return [
            name
            for name, one in arrays.items()
            if name not in read and one.dtype.kind in "fciu" and lines > 1 and lines in one.shape
        ]

    def square(self) -> list[str]:
        """Return the names of the matrices that may be points x columns as well as columns x points."""
        read = {name for parts in self._beams().values() for name in parts.values()}
        read |= {self.name(role) for role in ("position", "direction") if self.name(role)}
        return [name for name in read if np.ndim(one := self.held[name]) == 2 and len(set(one.shape)) == 1]

    def _rows_of(self, parts: Mapping[str, str], axis: str, freq: Array) -> list[Row]:
        """Return one row for every point of a beam, whose real and imaginary ``parts`` may be apart."""
        source = next(iter(parts.values()))
        usd = self.held.get(f"usd_{axis}", self.held.get("usd"))
        usd = usd if isinstance(usd, Mapping) else {}
        if np.any(np.asarray(usd.get("PowerSignal", 0)) == 1):
            step = "Export the FFT or the FRF: an auto or cross power has no phase of its own"
            self.refuse(source, "an amplitude spectrum", "a power", step)
        value, other = (self.shaped(parts.get(part, source), len(freq)) for part in ("re", "im"))
        if value.shape != other.shape or ({"re", "im"} - set(parts) and not np.iscomplexobj(value)):
            want, step = "complex, or of two parts", "Export Real & Imag.: without phase there is no motion"
            self.refuse(f"the variable {source}", want, "real numbers alone", step)
        value = value if np.iscomplexobj(value) else from_parts(value, np.real(other))
        count, lines = value.shape
        names = self.texts(self.name("points"), count)
        if not any(names) or (count > 1 and len(set(names)) == 1):  # one text for all is a title
            names = [self.element] if self.element and count == 1 else [str(k) for k in range(1, count + 1)]
        bodies, places = self.texts("body", count), np.full((count, 3), np.nan)
        if name := self.name("position"):
            places = self.shaped(name, 3, count).astype(float) * LENGTHS[self.length_unit or "m"]
        noise = {}
        for role in ("sd", "coherence", "n_avg"):
            if name := self.name(role, axis):
                single = np.size(self.held[name]) == 1
                known = self.numbers(name).reshape(1, 1) if single else self.shaped(name, lines, count)
                noise[role] = np.broadcast_to(np.real(known).astype(float), value.shape)
        words = (self.held.get(name, "") for name in (self.name("unit"), "amplitude"))
        unit, amplitude = (word if isinstance(word, str) else "" for word in words)
        directions = self._directions(axis, usd, count)
        return [
            Row(
                names[k], freq, value[k], f"{unit or usd.get('YUnit', '')} {amplitude}".strip(), bodies[k],
                position_m=places[k], direction=directions[k], source=source,
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
        dofs = usd.get("ResponseDOFs")  # +-1, 2, 3 for +-x, y, z, or texts
        dofs = dofs[0] if isinstance(dofs, list | np.ndarray) and len(dofs) else dofs
        code = dofs.get("Direction", 0) if isinstance(dofs, Mapping) and not stated else 0
        if isinstance(code, str) and (text := _DOF_TEXT.fullmatch(code)):
            stated = ("-" if text[1] == "Minus" else "") + text[2].lower()
        elif np.size(code) == 1 and np.asarray(code).dtype.kind in "fiu" and abs(code) in (1, 2, 3):
            stated = ("-" if code < 0 else "") + "xyz"[int(abs(code)) - 1]
        vector = direction_of(stated, self.file, name) if stated else unknown_vector()
        return np.tile(vector, (count, 1))
