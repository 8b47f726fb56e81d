"""Read a scan file of Polytec's PSV 10 (.svd): averaged FFT, one vibrometer channel and one reference.

An .svd is an OLE2 compound file (read by olefile). Each medium ``Polytec_Data/M<n>`` holds one averaged
quantity of all points; its ``Static_Info`` names channels, quantities and the formula in words,
``AVG[CP[S[T[0]],S[T[1]]]]`` for the cross power of channels 0 and 1 and ``AVG[AP[S[T[0]]]]`` for the auto
power of channel 0. Numbers are little-endian.

The layout was found by comparing scans of PSV 10.0 with the universal files that PSV exported of them:
frequencies, coordinates, directions, and the responses H1 and H2 agree to the rounding of the export.
Whatever differs from that layout is refused, with what was found.
"""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from kinematics.readers.recording import Recording, Row, unknown_vector
from kinematics.readers.stated_by_user import FileFacts
from kinematics.readers.units import MotionUnit
from stapeskit.arrays import Array, ComplexArray
from stapeskit.faults import Place, StapeskitError
from stapeskit.warnings import Notice

if TYPE_CHECKING:
    from olefile import OleFileIO

VELOCITY = 12
"""Code of the quantity velocity (m/s)."""

REFERENCES = {18: "N", 24: "V"}
"""Units of references by the code of their quantity: force, voltage."""

DIRECTIONS = {2: (1, 0, 0), 3: (-1, 0, 0), 4: (0, 1, 0), 5: (0, -1, 0), 6: (0, 0, 1), 7: (0, 0, -1)}
"""Directions of a channel by their code, towards the laser head."""

CHECKED_DIRECTIONS = (2, 3, 4)
"""Codes that exports confirm; the others continue their order."""

AVERAGED_FFT = 2
"""Code of complex averaging of spectra."""

EXPORT = (
    "Export the scan in the PSV program as a universal file (File, Export, Universal File, with the "
    "geometry and H1 or FFT of all points) and give that file"
)

_VERSIONS = {
    "Average": 1, "Fft": 2, "Channels": 10, "MeasPoints": 7, "Static_Info": 2, "Media_Type": 2,
    "ManyStreamsInfo": 1,
}  # fmt: skip
"""Versions of the layouts of streams: the first number of each."""

_POINT = np.dtype(
    {"names": ["number", "xyz"], "formats": ["<i4", "(3,)<f4"], "offsets": [0, 16], "itemsize": 56}
)
_POINTS_AT = 90  # number of points in MeasPoints; the points follow
_AXIS_AT = 82  # first and last frequency and number of lines in Media_Type
_NAMES_AT = 107  # names of a channel in Channels, from its start
_BEHIND_NAMES = 231  # bytes from the names of a channel to the next channel
_RECORD_HEAD = 248  # bytes of a record before its values; the four before hold their size
_CROSS = re.compile(r"AVG\[CP\[S\[T\[(\d+)\]\],S\[T\[(\d+)\]\]\]\]")


@dataclass(frozen=True)
class Medium:
    """One averaged quantity: its formula, names and quantities of its channels by number, lines."""

    folder: str
    formula: str
    names: dict[int, str]
    quantities: dict[int, int]
    freq_hz: Array


def read(path: Path, facts: FileFacts) -> Recording:  # noqa: ARG001
    """Read the responses H1 of a scan file, with the coherence that gives their noise.

    Raises
    ------
    StapeskitError
        Another version, mode, quantity or number of channels than the reader knows, or a damaged file.
    """
    import olefile

    path = Path(path)
    try:
        with olefile.OleFileIO(path) as ole:
            return _File(ole, path.name).recording()
    except StapeskitError:
        raise
    except (OSError, struct.error, IndexError, ValueError) as fault:  # olefile and short streams
        want, got = "whole, as PSV 10 writes it", "one that is cut short or damaged"
        raise StapeskitError.of("the scan file", want, got, path.name, EXPORT) from fault


@dataclass(frozen=True)
class _File:
    """The streams of an open scan file, and its name for messages."""

    ole: OleFileIO
    name: str

    def require(self, good: object, thing: str, expected: str, got: object) -> None:
        """Refuse what differs from the known layout, with how to export the scan."""
        if not good:
            raise StapeskitError.of(thing, expected, got, self.name, EXPORT)

    def stream(self, name: str) -> bytes:
        """Return a stream whose first number is the version of its layout that this reader knows."""
        content: bytes = self.ole.openstream(name).read()
        known, version = _VERSIONS[name.rsplit("/", 1)[-1]], _numbers("<i", content, 0)[0]
        self.require(version == known, f"the layout of {name}", f"version {known}", f"version {version}")
        return content

    def recording(self) -> Recording:
        """Read H1 (cross power over auto power of the reference) of every point that was measured."""
        cross, own, other = self.spectra()
        one, two = _channels_of(cross)
        names = (cross.names.get(one, ""), cross.names.get(two, ""))
        mode, _, averages = _numbers("<3i", self.stream("Info/DAQ_Settings_Fft/Average"), 4)
        good, got = mode == AVERAGED_FFT and averages >= 1, f"mode {mode} with {averages} averages"
        self.require(good, "the averaging", "complex averaging of spectra", got)
        notices = list[Notice]()
        direction = self.direction(names, notices)
        points = self.points()
        power = self.records(cross, "<c8", len(points))
        auto, reference = (self.records(medium, "<f4", len(points)).real for medium in (own, other))
        measured = ~np.all(np.isnan(power * auto * reference), axis=1)
        if not np.all(measured):
            text = f"{np.sum(~measured)} points of {self.name} were not measured and are left out."
            notices.append(Notice("zero_rows", text))
        with np.errstate(divide="ignore", invalid="ignore"):
            response = power / reference
            coherence = np.abs(power) ** 2 / (auto * reference)  # above 1 in a damaged file
        response[~np.isfinite(response)] = np.nan  # an empty line: a missing value
        unit = MotionUnit(1, per=REFERENCES.get(cross.quantities.get(two, 0), f"unit of {names[1]}"))
        rows = [
            Row(
                str(point + 1), cross.freq_hz, response[point], unit, position_m=points[point],
                direction=direction, coherence=coherence[point], n_avg=float(averages),
                where=Place(self.name, "point", (point + 1,)),
            )
            for point in np.flatnonzero(measured).tolist()
        ]  # fmt: skip
        version = self.ole.openstream("FileVersion").read()
        statement = (
            f"PSV {version[9]}.{version[8]}, aligned coordinates in metres, H1 of {names[0]} over "
            f"{names[1]}, {averages} averages"
        )
        return Recording(self.name, tuple(rows), tuple(notices), statement)

    def spectra(self) -> tuple[Medium, Medium, Medium]:
        """Return the one cross power of the file, and the auto powers of its vibrometer and reference."""
        streams = {"/".join(name) for name in self.ole.listdir()}
        modes = sorted({name.split("/")[1] for name in streams if name.startswith("Info/DAQ_Settings")})
        known = "Info/DAQ_Settings_Fft/Fft" in streams
        self.require(known, "the acquisition mode", "FFT", ", ".join(modes) or "none")
        folders = sorted({name.split("/")[1] for name in streams if name.startswith("Polytec_Data/")})
        media = {medium.formula: medium for medium in map(self.medium, folders)}
        crosses = [medium for formula, medium in media.items() if _CROSS.fullmatch(formula)]
        autos = [f"AVG[AP[S[T[{number}]]]]" for cross in crosses for number in _channels_of(cross)]
        want = "one cross power of a vibrometer channel and a reference, with both auto powers"
        good = len(crosses) == 1 and set(autos) <= set(media)
        self.require(good, "the averaged spectra", want, ", ".join(media) or "none")
        cross, own, other = crosses[0], media[autos[0]], media[autos[1]]
        same = all(np.array_equal(medium.freq_hz, cross.freq_hz) for medium in (own, other))
        self.require(same, "the spectra", "of the same frequencies", "different ones")
        code = cross.quantities.get(_channels_of(cross)[0])
        self.require(code == VELOCITY, "the quantity of the vibrometer", "velocity", f"code {code}")
        return cross, own, other

    def medium(self, folder: str) -> Medium:
        """Read what a medium holds: its formula, channels, quantities and frequencies."""
        content = self.stream(f"Polytec_Data/{folder}/Static_Info")
        count = _numbers("<i", content, 60)[0]
        triples = [_numbers("<3i", content, 64 + 12 * k) for k in range(count)]
        at = 64 + 12 * count + 8
        names: dict[int, str] = {}
        for _ in range(_numbers("<i", content, at - 4)[0]):
            number = _numbers("<i", content, at)[0]
            _, at = _text(content, at + 4)
            names[number], at = _text(content, at)
        formula, _ = _text(content, at)
        first, last, lines = _numbers("<2di", self.stream(f"Polytec_Data/{folder}/Media_Type"), _AXIS_AT)
        rate, _, samples = _numbers("<d2i", self.stream("Info/DAQ_Settings_Fft/Fft"), 4)
        step = rate / samples if samples > 0 else np.nan
        spaced = lines >= 2 and np.isclose((last - first) / (lines - 1), step, rtol=1e-9)
        got = f"{lines} lines from {first:g} to {last:g} Hz, {samples} samples at {rate:g} Hz"
        want = "spaced as the sampling says"
        self.require(spaced and 0.0 < step < np.inf, f"the frequencies of {formula}", want, got)
        quantities = {channel: code for code, _, channel in triples}
        return Medium(folder, formula, names, quantities, first + step * np.arange(lines))

    def direction(self, names: tuple[str, str], notices: list[Notice]) -> Array:
        """Return the direction (3,) of the one active vibrometer, NaN where its code is not known.

        A channel: version (int), a number (double), direction (int), further numbers, at byte 107 short and
        long name, then an int and three flags (the second says active, the third vibrometer), and further
        numbers.
        """
        content = self.stream("Info/DAQ_Settings_Fft/Channels")
        at, active, heads = 8, list[str](), dict[str, int]()
        for _ in range(_numbers("<i", content, 4)[0]):
            version, _, code = _numbers("<idi", content, at)
            short, behind = _text(content, at + _NAMES_AT)
            _, behind = _text(content, behind)
            flags = content[behind + 5], content[behind + 6]
            good = version == 11 and max(flags) <= 1
            self.require(good, "the layout of a channel", "version 11", f"version {version}")
            active += [short] * flags[0]
            heads |= {short: code} if all(flags) else {}
            at = behind + _BEHIND_NAMES
        got = f"{', '.join(heads)}; spectra of {' and '.join(names)}"
        good = [*heads] == [names[0]] and names[1] in active
        self.require(good, "the active vibrometer channels", "one, against one reference", got)
        code = heads[names[0]]
        if code in DIRECTIONS and code not in CHECKED_DIRECTIONS:
            text = (
                f"the direction of channel {names[0]} in {self.name} has the code {code}, read as "
                f"{DIRECTIONS[code]} by the order of the codes 2 to 4 that exports confirm: compare it with "
                "the direction that the PSV program shows."
            )
            notices.append(Notice("axes_assumed", text))
        return np.array(DIRECTIONS.get(code, unknown_vector()), dtype=float)

    def points(self) -> Array:
        """Return the coordinates of the points, (p, 3), m; NaN where all are zero."""
        content = self.stream("Info/Geometry/MeasPoints")
        count = _numbers("<i", content, _POINTS_AT)[0]
        self.require(count > 0, "the number of points", "positive", count)
        points = np.frombuffer(content, _POINT, count, _POINTS_AT + 4)
        good = np.array_equal(points["number"], np.arange(1, count + 1))
        self.require(good, "the points", "numbered from 1", points["number"][:5])
        xyz = points["xyz"].astype(float)
        return xyz if np.any(xyz) else np.full(xyz.shape, np.nan)

    def records(self, medium: Medium, kind: str, points: int) -> ComplexArray:
        """Return the values of a medium, (p, L), NaN at points without a record."""
        info = np.frombuffer(self.stream(f"Polytec_Data/{medium.folder}/ManyStreamsInfo"), "<i4")
        size, count = int(info[1]), int(info[4])
        lengths, order = info[6 + count : 6 + 3 * count].reshape(count, 2).T
        content = self.ole.openstream(f"Polytec_Data/{medium.folder}/ManyStreamsData-0").read()[8:]
        lines = len(medium.freq_hz)
        known = order[order >= 0].tolist()
        sound = size > 0 and len(content) % size == 0 and len(set(known)) == len(known)
        sound = sound and count == points and size * (max(known, default=0) + 1) <= len(content)
        got = f"{count} entries, {len(known)} records of {size} bytes for {points} points"
        self.require(sound, f"the records of {medium.formula}", "one a point", got)
        values = np.full((points, lines), np.nan, dtype=complex)
        for point in np.flatnonzero(order >= 0).tolist():
            part = content[size * order[point] : size * (order[point] + 1)]
            stated, owner, held = (_numbers("<i", part, at)[0] for at in (8, 32, _RECORD_HEAD - 4))
            good = (owner, stated, held) == (point, lines, np.dtype(kind).itemsize * lines)
            got = f"{stated} lines and {held} bytes of point {owner + 1} as those of point {point + 1}"
            good = good and lengths[point] <= size
            self.require(good, f"a record of {medium.formula}", f"of {lines} lines", got)
            values[point] = np.frombuffer(part, kind, lines, _RECORD_HEAD)
        return values


def _channels_of(cross: Medium) -> tuple[int, int]:
    """Return the numbers of vibrometer and reference of a cross power."""
    one, two = re.findall(r"\d+", cross.formula)
    return int(one), int(two)


def _numbers(form: str, content: bytes, at: int) -> tuple[Any, ...]:
    return struct.unpack_from(form, content, at)


def _text(content: bytes, at: int) -> tuple[str, int]:
    """Return a text behind its length in bytes, in UTF-16 with a zero at its end, and the place behind it."""
    size = _numbers("<i", content, at)[0]
    if not 0 <= size <= len(content) - at - 4:
        raise IndexError(f"a text of {size} bytes at byte {at}")
    return content[at + 4 : at + 4 + size].decode("utf-16le").rstrip("\0"), at + 4 + size
