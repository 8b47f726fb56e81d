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
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from kinematics.readers.facts import FileFacts
from kinematics.readers.recording import Channel, Recording, Row, recording_of, unknown_vector
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
    "Average": 1,
    "Fft": 2,
    "Channels": 10,
    "MeasPoints": 7,
    "Static_Info": 2,
    "Media_Type": 2,
    "ManyStreamsInfo": 1,
}
_POINT_BYTES = 56  # of a point in MeasPoints
_POINTS_AT = 90  # number of points in MeasPoints; the points follow
_AXIS_AT = 82  # first and last frequency and number of lines in Media_Type
_NAMES_AT = 107  # names of a channel in Channels, from its start
_BEHIND_NAMES = 231  # bytes from the names of a channel to the next channel
_RECORD_HEAD = 248  # bytes of a record before its values; the four before hold their size


@dataclass(frozen=True)
class Medium:
    """One averaged quantity: its formula, names and quantities of its channels by number, lines."""

    folder: str
    formula: str
    names: dict[int, str]
    quantities: dict[int, int]
    freq_hz: Array


@dataclass(frozen=True)
class Scan:
    """What the scan file holds; p points, L lines, in SI.

    Attributes
    ----------
    points_m : ndarray, (p, 3)
        In the aligned coordinates of the scan; NaN where the file has none.
    measured : ndarray, (p,), bool
    cross : ndarray, (p, L), complex
        Averaged cross power of vibrometer and reference, vibrometer times conjugate of reference.
    auto, auto_reference : ndarray, (p, L)
        Averaged auto powers.
    """

    version: str
    freq_hz: Array
    points_m: Array
    measured: np.ndarray[tuple[int, ...], np.dtype[np.bool_]]
    cross: ComplexArray
    auto: Array
    auto_reference: Array
    direction_code: int
    reference_code: int
    names: tuple[str, str]
    averages: int

    @property
    def h1(self) -> ComplexArray:
        """Response with noise in the vibrometer alone: cross power over auto power of the reference."""
        return np.asarray(self.cross / self.auto_reference)

    @property
    def h2(self) -> ComplexArray:
        """Response with noise in the reference alone: auto power of the vibrometer over the cross power."""
        return np.asarray(self.auto / self.cross.conj())

    @property
    def coherence(self) -> Array:
        """Ordinary coherence."""
        return np.asarray(np.abs(self.cross) ** 2 / (self.auto * self.auto_reference))


def read(path: Path, facts: FileFacts) -> Recording:  # noqa: ARG001
    """Read the responses H1 of a scan file, with the coherence that gives their noise.

    Raises
    ------
    StapeskitError
        Another version, mode, quantity or number of channels than the reader knows, or a damaged file.
    """
    path = Path(path)
    scan = read_scan(path)
    notices = []
    if not np.all(scan.measured):
        lost = int(np.sum(~scan.measured))
        notices.append(
            Notice("zero_rows", f"{lost} points of {path.name} were not measured and are left out.")
        )
    direction = np.array(DIRECTIONS.get(scan.direction_code, unknown_vector()), dtype=float)
    if scan.direction_code not in CHECKED_DIRECTIONS and scan.direction_code in DIRECTIONS:
        text = (
            f"the direction of channel {scan.names[0]} in {path.name} has the code {scan.direction_code}, "
            f"read as {direction.astype(int).tolist()} by the order of the codes 2 to 4 that exports "
            "confirm: compare it with the direction that the PSV program shows."
        )
        notices.append(Notice("direction_assumed", text))
    per = REFERENCES.get(scan.reference_code, f"unit of {scan.names[1]}")
    # the ratio of powers of an empty line is no number: a missing value
    with np.errstate(divide="ignore", invalid="ignore"):
        response, coherence = scan.h1, np.clip(scan.coherence, 0.0, 1.0)
    response[~np.isfinite(response)] = np.nan
    rows = [
        Row(
            Channel(
                str(point + 1), order=1, per=per, position_m=scan.points_m[point], direction=direction,
                where=Place(path.name, "point", (int(point) + 1,)),
            ),
            scan.freq_hz,
            response[point],
            coherence=coherence[point],
            n_avg=float(scan.averages),
        )
        for point in np.flatnonzero(scan.measured)
    ]  # fmt: skip
    statement = (
        f"PSV {scan.version}, aligned coordinates in metres, H1 of {scan.names[0]} over {scan.names[1]}, "
        f"{scan.averages} averages"
    )
    return recording_of(path.name, rows, notices=tuple(notices), statement=statement, amplitude_stated=True)


def read_scan(path: Path) -> Scan:
    """Read the averaged powers of a scan file.

    Raises
    ------
    StapeskitError
        As `read`.
    """
    import olefile

    try:
        with olefile.OleFileIO(path) as ole:
            return _scan(ole, path.name)
    except (OSError, struct.error, IndexError, UnicodeDecodeError) as fault:  # olefile and short streams
        reason = " ".join(str(fault).split())[:120] or type(fault).__name__
        raise StapeskitError.of(
            "the scan file", "whole, as PSV 10 writes it", reason, path.name, EXPORT
        ) from fault


def _scan(ole: OleFileIO, file: str) -> Scan:
    """Read the streams of an open scan file."""
    streams = {"/".join(name) for name in ole.listdir()}
    if "Info/DAQ_Settings_Fft/Fft" not in streams:
        modes = sorted({name.split("/")[1] for name in streams if name.startswith("Info/DAQ_Settings")})
        raise _refused("the acquisition mode", "FFT", ", ".join(modes) or "none that is named", file)
    whole = ole.openstream("FileVersion").read()
    version = f"{whole[9]}.{whole[8]}"
    folders = sorted({name.split("/")[1] for name in streams if name.startswith("Polytec_Data/")})
    media = [_medium(ole, folder, file) for folder in folders]
    by_formula = {medium.formula: medium for medium in media}
    crosses = [f for f in by_formula if re.fullmatch(r"AVG\[CP\[S\[T\[\d+\]\],S\[T\[\d+\]\]\]\]", f)]
    if len(crosses) != 1:
        want = "one cross power of a vibrometer channel and a reference"
        raise _refused("the averaged spectra", want, ", ".join(by_formula) or "none", file)
    cross = by_formula[crosses[0]]
    one, other = (int(number) for number in re.findall(r"T\[(\d+)\]", crosses[0]))
    autos = [by_formula.get(f"AVG[AP[S[T[{number}]]]]") for number in (one, other)]
    if autos[0] is None or autos[1] is None:
        raise _refused(
            "the averaged spectra", "with the auto powers of both channels", ", ".join(by_formula), file
        )
    for medium in autos:
        if medium is not None and not np.array_equal(medium.freq_hz, cross.freq_hz):
            raise _refused("the spectra", "of the same frequencies", "different ones", file)
    channels = {name: (code, vibrometer) for name, code, vibrometer in _channels(ole, file)}
    vibrometers = [name for name, (_, vibrometer) in channels.items() if vibrometer]
    names = (cross.names.get(one, ""), cross.names.get(other, ""))
    if vibrometers != [names[0]] or names[1] not in channels:
        got = f"{len(vibrometers)} ({', '.join(vibrometers)}), spectra of {' and '.join(names)}"
        raise _refused("the active vibrometer channels", "one, against one reference", got, file)
    if cross.quantities.get(one) != VELOCITY:
        raise _refused(
            "the quantity of the vibrometer", "velocity", f"code {cross.quantities.get(one)}", file
        )
    points = _points(ole, file)
    averages = _averages(ole, file)
    powers = [
        _records(ole, medium, kind, len(points), file)
        for medium, kind in ((cross, "<c8"), (autos[0], "<f4"), (autos[1], "<f4"))
    ]
    measured = ~np.any([np.all(np.isnan(power.real), axis=1) for power in powers], axis=0)
    return Scan(
        version,
        cross.freq_hz,
        points,
        measured,
        powers[0],
        powers[1].real,
        powers[2].real,
        channels[names[0]][0],
        cross.quantities.get(other, 0),
        names,
        averages,
    )


def _refused(thing: str, expected: str, got: str, file: str) -> StapeskitError:
    return StapeskitError.of(thing, expected, got, file, EXPORT)


def _stream(ole: OleFileIO, name: str, file: str) -> bytes:
    """Return a stream whose first number is the version of its layout that this reader knows."""
    content: bytes = ole.openstream(name).read()
    known = _VERSIONS[name.rsplit("/", 1)[-1]]
    version = struct.unpack_from("<i", content)[0]
    if version != known:
        raise _refused(f"the layout of {name}", f"version {known}", f"version {version}", file)
    return content


def _text(content: bytes, at: int) -> tuple[str, int]:
    """Return a text behind its length in bytes, in UTF-16 with a zero at its end, and the place behind it."""
    size = struct.unpack_from("<i", content, at)[0]
    if not 0 <= size <= len(content) - at - 4:
        raise IndexError(f"a text of {size} bytes at byte {at}")
    return content[at + 4 : at + 4 + size].decode("utf-16le").rstrip("\0"), at + 4 + size


def _medium(ole: OleFileIO, folder: str, file: str) -> Medium:
    """Read what a medium holds: its formula, channels, quantities and frequencies."""
    content = _stream(ole, f"Polytec_Data/{folder}/Static_Info", file)
    count = struct.unpack_from("<i", content, 60)[0]
    triples = [struct.unpack_from("<3i", content, 64 + 12 * k) for k in range(count)]
    quantities = {channel: code for code, _, channel in triples}
    at = 64 + 12 * count + 8
    channels = struct.unpack_from("<i", content, at - 4)[0]
    names: dict[int, str] = {}
    for _ in range(channels):
        number = struct.unpack_from("<i", content, at)[0]
        _, at = _text(content, at + 4)
        names[number], at = _text(content, at)
    formula, _ = _text(content, at)
    media = _stream(ole, f"Polytec_Data/{folder}/Media_Type", file)
    first, last, lines = struct.unpack_from("<2di", media, _AXIS_AT)
    rate, samples = _sampling(ole, file)
    step = rate / samples
    if lines < 2 or not np.isclose((last - first) / (lines - 1), step, rtol=1e-9):
        got = f"{lines} lines from {first:g} to {last:g} Hz, {samples} samples at {rate:g} Hz"
        raise _refused(f"the frequencies of {formula}", "spaced as the sampling says", got, file)
    return Medium(folder, formula, names, quantities, first + step * np.arange(lines))


def _sampling(ole: OleFileIO, file: str) -> tuple[float, int]:
    """Return sampling rate, Hz, and samples of a record."""
    content = _stream(ole, "Info/DAQ_Settings_Fft/Fft", file)
    rate, _, samples = struct.unpack_from("<d2i", content, 4)
    if not (0.0 < rate < np.inf and samples > 0):
        raise _refused("the sampling", "positive", f"{samples} samples at {rate:g} Hz", file)
    return rate, samples


def _averages(ole: OleFileIO, file: str) -> int:
    """Return the number of averaged spectra."""
    mode, _, count = struct.unpack_from("<3i", _stream(ole, "Info/DAQ_Settings_Fft/Average", file), 4)
    if mode != AVERAGED_FFT or count < 1:
        raise _refused(
            "the averaging", "complex averaging of spectra", f"mode {mode} with {count} averages", file
        )
    return int(count)


def _channels(ole: OleFileIO, file: str) -> Iterator[tuple[str, int, bool]]:
    """Give the active channels: short name, code of the direction, whether it is a vibrometer.

    A channel: version (int), a number (double), direction (int), further numbers, at byte 107 short and long
    name, then an int and three flags (the second says active, the third vibrometer), and further numbers.
    """
    content = _stream(ole, "Info/DAQ_Settings_Fft/Channels", file)
    at = 8
    for _ in range(struct.unpack_from("<i", content, 4)[0]):
        version, _, direction = struct.unpack_from("<idi", content, at)
        short, behind = _text(content, at + _NAMES_AT)
        _, behind = _text(content, behind)
        active, vibrometer = content[behind + 5], content[behind + 6]
        if version != 11 or active > 1 or vibrometer > 1:
            raise _refused("the layout of a channel", "version 11", f"version {version}", file)
        if active:
            yield short, direction, bool(vibrometer)
        at = behind + _BEHIND_NAMES


def _points(ole: OleFileIO, file: str) -> Array:
    """Return the coordinates of the points, (p, 3), m; NaN where all are zero."""
    content = _stream(ole, "Info/Geometry/MeasPoints", file)
    count = struct.unpack_from("<i", content, _POINTS_AT)[0]
    if not 1 <= count <= (len(content) - _POINTS_AT) // _POINT_BYTES + 1:
        raise _refused("the number of points", "as many as the file holds", str(count), file)
    begin = _POINTS_AT + 4
    numbers = [struct.unpack_from("<i", content, begin + _POINT_BYTES * k)[0] for k in range(count)]
    if numbers != list(range(1, count + 1)):
        raise _refused("the points", "numbered from 1", f"{numbers[:5]}", file)
    places = [np.frombuffer(content, "<f4", 3, begin + _POINT_BYTES * k + 16) for k in range(count)]
    points = np.array(places, dtype=float)
    return np.full(points.shape, np.nan) if not np.any(points) else points


def _records(ole: OleFileIO, medium: Medium, kind: str, points: int, file: str) -> ComplexArray:
    """Return the values of a medium, (p, L), NaN at points without a record."""
    info = np.frombuffer(_stream(ole, f"Polytec_Data/{medium.folder}/ManyStreamsInfo", file), "<i4")
    size, count = int(info[1]), int(info[4])
    lengths, order = info[6 + count : 6 + 3 * count].reshape(count, 2).T
    content = ole.openstream(f"Polytec_Data/{medium.folder}/ManyStreamsData-0").read()[8:]
    used = np.dtype(kind).itemsize * len(medium.freq_hz)
    known = order[order >= 0].tolist()
    sound = size > 0 and len(content) % size == 0 and len(set(known)) == len(known)
    if count != points or not sound or size * (max(known, default=0) + 1) > len(content):
        got = f"{count} entries, {len(known)} records of {size} bytes for {points} points"
        raise _refused(f"the records of {medium.formula}", "one a point", got, file)
    values = np.full((points, len(medium.freq_hz)), np.nan, dtype=complex)
    for point, record in enumerate(order.tolist()):
        if record < 0:
            continue
        part = content[size * record : size * (record + 1)]
        lines, owner, held = (struct.unpack_from("<i", part, at)[0] for at in (8, 32, _RECORD_HEAD - 4))
        if owner != point or lines != len(medium.freq_hz) or held != used or lengths[point] > size:
            got = f"{lines} lines and {held} bytes of point {owner + 1} as those of point {point + 1}"
            raise _refused(f"a record of {medium.formula}", f"of {len(medium.freq_hz)} lines", got, file)
        values[point] = np.frombuffer(part, kind, len(medium.freq_hz), _RECORD_HEAD)
    return values
