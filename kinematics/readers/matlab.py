"""Read spectra of MATLAB and HDF5 files by the names of their variables, as File Access scripts save them.

``x`` (F, Hz) and ``y`` (points x F, complex, or ``y_re`` and ``y_im``) with the struct ``usd`` that
GetPointData returns or a text ``unit``; ``xyz`` of GetXYZCoordinates (points x 3, m); one value a beam
(``amp_x``, ``amp_y``, ``amp_z`` with ``usd_x`` ...) or points x F x 3 for beams x, y, z; ``direction``,
``coherence``, ``sd``, ``n_avg``, ``points``, ``body``. All of it in the file, in one struct, or in a struct
array with one element a channel.
"""

from __future__ import annotations

import re
from collections import ChainMap
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinematics.readers.facts import FileFacts
from kinematics.readers.gather import Row, from_parts, recording_of
from kinematics.readers.recording import Channel, Recording, unknown_vector
from kinematics.readers.text import plain_name
from kinematics.readers.tree import STRINGS, read_tree
from kinematics.readers.units import LENGTHS
from stapeskit.arrays import Array
from stapeskit.faults import Fault, Place, StapeskitError, collect_faults, list_some, raise_all
from stapeskit.frames import axis_vector
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
    "body": ("body",),
    "amplitude": ("amplitude",),
}
"""Names that variables may have, in any case, by what they hold."""

VALUES = ("y", "v", "amp", "vib", "fft", "frf", "h1", "h2", "value")
_VALUE = re.compile(rf"(?:{'|'.join(VALUES)})(?:_?([xyz]))?(?:_?(re|im|real|imag))?|(re|im|real|imag)")
_LENGTH_END = re.compile(r"_(mm|um|m)$")
_STRING_STEP = "Save it as char or cell array: names = cellstr(names); unit = char(unit); then save again"
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
    path = Path(path)
    tree = read_tree(path)
    strings = [name for name, value in tree.items() if isinstance(value, str) and value == STRINGS]
    unread = f"MATLAB string arrays ({', '.join(strings)})"
    notice = Notice("file_read", f"{path.name}: {unread} were not read. {_STRING_STEP}.")
    try:
        spaces = _spaces({name: one for name, one in tree.items() if name not in strings}, path.name)
        return recording_of(
            path.name,
            [row for space in spaces for row in space.rows()],
            notices=(notice,) if strings else (),
            statement=f"variables of {path.name}",
            length_stated=all(bool(space.length_unit) or not space.name("position") for space in spaces),
        )
    except StapeskitError as error:
        want = "of char, cell or number arrays"
        first = [Fault("the variables", want, unread, path.name, _STRING_STEP)] if strings else []
        raise StapeskitError(*first, *error.faults) from None


def _spaces(tree: Mapping[str, Any], file: str) -> list[Space]:
    """Return the variables of a file, with those of its one struct, or of each element of its struct array."""
    top = Space(tree, file)
    if top.name("frequency"):
        return [top]
    structs = {name: value for name, value in tree.items() if isinstance(value, Mapping)}
    arrays = {name: value for name, value in tree.items() if _is_struct_array(value)}
    if len(structs) + len(arrays) == 1:
        name = next(iter({**structs, **arrays}))
        inner = [structs[name]] if structs else list(arrays[name])
        around = {key: one for key, one in tree.items() if key != name}
        spaces = [
            Space(ChainMap(dict(fields), around), f"{file}, {name}", str(number) if arrays else "")
            for number, fields in enumerate(inner, 1)
        ]
        if all(space.name("frequency") for space in spaces):
            return spaces
    sizes = {name: " x ".join(map(str, np.shape(value))) for name, value in tree.items()}
    listed = list_some((f"{name} ({size})" if size else name for name, size in sizes.items()), 12)
    raise StapeskitError.of(file, "of a known layout", f"the variables {listed or 'none'}", "", _STEP)


def _is_struct_array(value: Any) -> bool:
    listed = isinstance(value, list) or (isinstance(value, np.ndarray) and value.dtype == object)
    return listed and np.ndim(value) == 1 and all(isinstance(one, Mapping) for one in value)


@dataclass(frozen=True)
class Space:
    """Variables by name, of the file or of a struct before those around it; ``where`` is for messages.

    ``point`` is the number of an element of a struct array: the name of its point where it holds none.
    """

    names: Mapping[str, Any]
    where: str
    point: str = ""

    def name(self, role: str) -> str:
        """Return the first name of a role (a key of `NAMES`) that is there, in any case; empty without one."""
        low = {name.lower(): name for name in reversed(list(self.names))}
        return next((low[name] for name in NAMES[role] if name in low), "")

    def text(self, role: str) -> str:
        """Return the text of a role; empty without one."""
        value = self.names.get(self.name(role))
        return value if isinstance(value, str) else ""

    def texts(self, role: str, count: int) -> list[str]:
        """Return the texts of a role, one a row, or one for all; an empty one without any."""
        value = self.names.get(self.name(role), "")
        values = [value] if isinstance(value, str) else np.asarray(value).reshape(-1).tolist()
        texts = [plain_name(f"{one:g}" if isinstance(one, float) else str(one)) for one in values]
        texts = texts * count if len(texts) == 1 else texts
        if len(texts) != count:
            self.refuse(self.name(role), f"{count} texts, one a row", len(texts))
        return texts

    def numbers(self, name: str) -> NDArray[Any]:
        """Return an array of numbers."""
        value = np.asarray(self.names[name])
        if value.dtype.kind not in "fciub" or value.size == 0:
            self.refuse(f"the variable {name}", "an array of numbers", "something else")
        return value

    def shaped(self, name: str, lines: int) -> NDArray[Any]:
        """Return an array of points x lines [x 3 beams], in either order, as (point, line, beam)."""
        value = np.atleast_2d(self.numbers(name))
        if value.ndim == 2:
            value = (value.T if value.shape[1] != lines else value)[:, :, None]
        if value.ndim != 3 or value.shape[1] != lines:
            self.refuse(f"the variable {name}", f"points x {lines} frequencies", value.shape)
        return value

    def vectors(self, role: str, count: int) -> Array:
        """Return three numbers a point, (count, 3), of an array in either order or of one vector."""
        value = self.numbers(self.name(role))
        value = value.T if value.shape == (3, count) and count != 3 else np.atleast_2d(value)
        if value.shape not in ((count, 3), (1, 3)):
            self.refuse(self.name(role), f"points x 3, here {count} x 3", value.shape)
        return np.broadcast_to(value.astype(float), (count, 3)).copy()

    def refuse(self, thing: str, expected: str, got: object) -> None:
        """Refuse a variable."""
        got = " x ".join(map(str, got)) if isinstance(got, tuple) else got
        raise StapeskitError.of(thing, expected, got, self.where, "Correct it and save again")

    @property
    def length_unit(self) -> str:
        """The unit at the end of the name of the positions; empty without one."""
        ending = _LENGTH_END.search(self.name("position"))
        return ending[1] if ending else ""

    def rows(self) -> list[Row]:
        """Read every beam at every point; all faults of the variables together."""
        freq = self.numbers(self.name("frequency")).reshape(-1).astype(float)
        beams: dict[str, dict[str, str]] = {}
        for name in self.names:
            match = _VALUE.fullmatch(name.lower())
            if match and name != self.name("frequency") and not isinstance(self.names[name], Mapping):
                part = (match[2] or match[3] or "")[:2]
                beam = name.lower().removesuffix(match[2] or match[3] or "").rstrip("_")
                beams.setdefault(beam, {"axis": match[1] or ""})[part] = name
        if not beams:
            want, got = f"spectra named {', '.join(VALUES)}", list_some(self.names, 12)
            raise StapeskitError.of(self.where, want, f"the variables {got}", "", _STEP)
        faults: list[Fault] = []
        rows: list[Row] = []
        for parts in beams.values():
            with collect_faults(faults):
                rows += self._rows_of(parts, freq)
        raise_all(faults)
        return rows

    def _value(self, parts: Mapping[str, str], lines: int) -> NDArray[Any]:
        """Return complex values (point, line, beam) of one variable or of real and imaginary part."""
        if "re" in parts and "im" in parts:
            one, other = (self.shaped(parts[part], lines) for part in ("re", "im"))
            if one.shape != other.shape:
                self.refuse(f"{parts['re']} and {parts['im']}", "of one size", other.shape)
            return from_parts(np.real(one), np.real(other))
        name = parts.get("", next(iter([parts[part] for part in parts if part != "axis"])))
        value = self.shaped(name, lines)
        if not np.iscomplexobj(value):
            want, step = "complex", "Export Real & Imag.: without phase there is no motion"
            raise StapeskitError.of(f"the variable {name}", want, "real numbers", self.where, step)
        return value

    def _rows_of(self, parts: Mapping[str, str], freq: Array) -> list[Row]:
        """Return one row for every point and beam of a variable."""
        axis, source = parts["axis"], next(parts[part] for part in parts if part != "axis")
        structs = {key.lower(): one for key, one in self.names.items() if isinstance(one, Mapping)}
        usd = structs.get(f"usd_{axis}", structs.get("usd", {}))
        if np.any(np.asarray(usd.get("PowerSignal", 0)) == 1):
            step = "Export the FFT or the FRF: an auto or cross power has no phase of its own"
            raise StapeskitError.of(source, "an amplitude spectrum", "a power", self.where, step)
        value = self._value(parts, len(freq))
        count, lines, beams = value.shape
        names = self.texts("points", count) if self.name("points") else [self.point] * count
        if not any(names):
            names = [str(k) for k in range(1, count + 1)]
        bodies, places = self.texts("body", count), np.full((count, 3), np.nan)
        if self.name("position"):
            places = self.vectors("position", count) * LENGTHS[self.length_unit or "m"]
        noise = {}
        for role in ("sd", "coherence", "n_avg"):
            low = {name.lower(): name for name in self.names}
            own = [low[key] for one in NAMES[role] if (key := f"{one}_{axis}") in low]
            if name := own[0] if own else self.name(role):
                known = self.numbers(name)
                known = known.reshape(1, 1, 1) if known.size == 1 else self.shaped(name, lines)
                if known.shape[0] not in (1, count) or known.shape[2] not in (1, beams):
                    self.refuse(name, f"{count} x {lines}", known.shape)
                noise[role] = np.broadcast_to(np.real(known).astype(float), value.shape)
        unit = f"{self.text('unit') or usd.get('YUnit', '')} {self.text('amplitude')}".strip()
        rows = []
        for beam in range(beams):
            directions = self._directions("xyz"[beam] if beams == 3 else axis, usd, count)
            for k in range(count):
                channel = Channel(
                    names[k],
                    bodies[k],
                    position_m=places[k],
                    direction=directions[k],
                    where=Place(f"{self.where}, {source}", "row", (int(self.point or k + 1),)),
                )
                given = {role: matrix[k, :, beam] for role, matrix in noise.items()}
                rows.append(Row(channel, freq, value[k, :, beam], **given, unit=unit, source=source))
        return rows

    def _directions(self, axis: str, usd: Mapping[str, Any], count: int) -> Array:
        """Return the direction of the beam at every point, (count, 3), NaN where it is not stated."""
        text = axis or self.text("direction")
        if self.name("direction") and not text:
            return self.vectors("direction", count)
        vector = axis_vector(text) if text else _usd_direction(usd)
        return np.tile(unknown_vector() if vector is None else vector, (count, 1))


def _usd_direction(usd: Mapping[str, Any]) -> Array | None:
    """Return the direction of the first response that a signal description names; None without one."""
    dofs = usd.get("ResponseDOFs")
    dofs = dofs[0] if isinstance(dofs, list | np.ndarray) and len(dofs) else dofs
    code = dofs.get("Direction") if isinstance(dofs, Mapping) else None
    if isinstance(code, str):
        match = re.fullmatch(r"ptc(Plus|Minus)([XYZ])Translation", code)
        return axis_vector(("-" if match[1] == "Minus" else "") + match[2].lower()) if match else None
    number = np.asarray(code if code is not None else 0).reshape(-1)
    if number.size == 1 and number.dtype.kind in "fiu" and abs(float(number[0])) in (1.0, 2.0, 3.0):
        return np.asarray(np.sign(float(number[0])) * np.eye(3)[int(abs(number[0])) - 1])
    return None
