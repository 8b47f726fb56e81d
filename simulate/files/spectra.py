"""Write a recording as other programs export it: velocities along x, y, z of points, first run.

They are computed from three beams of each point, as a 3D scanning vibrometer does.
Points are numbered through all bodies, in points.csv too.
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from simulate.vibrometer import Recording
from stapeskit.arrays import Array, ComplexArray

_DATE = "21-Nov-26 12:00:00"


@dataclass(frozen=True, kw_only=True, eq=False)
class _Export:
    """Frequencies (L,), Hz; bodies and places (P, 3), mm, of the points; velocities (P, 3, L), m/s."""

    freq_hz: Array
    body: list[str]
    places_mm: Array
    velocity: ComplexArray


def _exported(recording: Recording, folder: Path) -> _Export:
    """Return velocities along x, y, z, and write points.csv, whose numbers go through all bodies.

    Raises
    ------
    ValueError
        The points do not have three beams each.
    """
    first = range(0, len(recording.point), 3)
    if int(recording.laser.max()) != 2:
        raise ValueError("velocities along x, y and z need three lasers.")
    beams, values = recording.direction, recording.velocity_m_s[0]
    velocity = np.array([np.linalg.solve(beams[k : k + 3], values[k : k + 3]) for k in first])
    # Universal files hold the first frequency and a step of six digits.
    step = float(f"{recording.freq_hz[1] - recording.freq_hz[0]:.5e}")
    freq = recording.freq_hz[0] + step * np.arange(len(recording.freq_hz))
    bodies, places = [recording.body[k] for k in first], np.round(recording.position_mm[::3], 4)
    rows = [
        f"{body},{number}," + ",".join(f"{v:.4f}" for v in place) + f",{recording.position_sd_mm or 1e-4:g}"
        for number, (body, place) in enumerate(zip(bodies, places, strict=True), 1)
    ]
    text = "\n".join(["body,point,x_mm,y_mm,z_mm,sd_mm", *rows]) + "\n"
    (folder / "points.csv").write_text(text, encoding="utf-8")
    return _Export(freq_hz=freq, body=bodies, places_mm=places, velocity=velocity)


def write_uff_binary(folder: Path, recording: Recording) -> Path:
    """Write datasets 164 (units), 15 (nodes, mm) and 58b (spectra of velocity, m/s, single precision)."""
    export = _exported(recording, folder)
    numbers = "".join(f"{value:25.16E}".replace("E", "D") for value in (1000.0, 1.0, 1.0))
    units = [f"{5:10d}{'mm (milli newton)':<20s}{2:10d}", numbers, f"{273.15:25.16E}".replace("E", "D")]
    nodes = [
        f"{number:10d}{0:10d}{0:10d}{11:10d}" + "".join(f"{v:13.5E}" for v in place)
        for number, place in enumerate(export.places_mm, 1)
    ]
    parts = [_dataset(164, units), _dataset(15, nodes)]
    for number, point in enumerate(export.velocity, 1):
        parts += [_spectrum(export.freq_hz, values, number, axis) for axis, values in enumerate(point, 1)]
    path = folder / "scan.uff"
    path.write_bytes(b"".join(parts))
    return path


def _dataset(number: int, lines: list[str]) -> bytes:
    return "\n".join(["    -1", f"{number:6d}", *lines, "    -1", ""]).encode("ascii")


def _spectrum(freq_hz: Array, values: ComplexArray, node: int, direction: int) -> bytes:
    """Return a dataset 58b: spectrum (12) of velocity (11) at a node along +x, +y or +z."""
    step, none = freq_hz[1] - freq_hz[0], f"{'NONE':<20s} {'NONE':<20s}"
    head = [
        "Response",
        "Vib Velocity",
        _DATE,
        "NONE",
        "NONE",
        f"{12:5d}{1:10d}{1:5d}{0:10d} {'NONE':<10s}{node:10d}{direction:4d} {'NONE':<10s}{0:10d}{0:4d}",
        f"{5:10d}{len(freq_hz):10d}{1:10d}{freq_hz[0]:13.5E}{step:13.5E}{0.0:13.5E}",
        f"{18:10d}{0:5d}{0:5d}{0:5d} {'Frequency':<20s} {'Hz':<20s}",
        f"{11:10d}{0:5d}{0:5d}{0:5d} {'Velocity':>20s} {'m/s':>20s}",
        f"{0:10d}{0:5d}{0:5d}{0:5d} {none}",
        f"{0:10d}{0:5d}{0:5d}{0:5d} {none}",
    ]
    data = np.column_stack([values.real, values.imag]).astype("<f4").tobytes()
    first = f"{58:6d}b{1:6d}{2:6d}{11:12d}{len(data):12d}{0:6d}{0:6d}{0:12d}{0:12d}"
    return "\n".join(["    -1", first, *head, ""]).encode("ascii") + data + b"    -1\n"


def write_fastscan(folder: Path, recording: Recording) -> Path:
    """Write a PSV FastScan text export, one block a frequency; positions in metres, without their unit."""
    export = _exported(recording, folder)
    blocks = []
    for line, freq in enumerate(export.freq_hz):
        parts = [f"{part} {axis} [m/s]" for part in ("Real", "Imaginary") for axis in "XYZ"]
        lines = [
            "Source File Name:\tear.svd",
            "Signal: FFT - Vib 3D Velocity - Real & Imag.",
            "",
            f"Band No.:\t {line + 1}",
            f"Frequency:\t{freq:.10g} Hz",
            "",
            "Interpolated:\tNo",
            "Filtered:\tNo",
            "",
            "\t".join(["Index", *"XYZ", *parts]),
        ]
        rows = zip(export.places_mm * 1e-3, export.velocity[:, :, line], strict=True)
        for number, (place, value) in enumerate(rows, 1):
            cells = [f"{v:.7f}" for v in place] + [f"{v:.4e}" for v in (*value.real, *value.imag)]
            lines.append("\t".join([str(number), *cells]))
        blocks.append("\r\n".join(lines) + "\r\n")
    path = folder / "fastscan.txt"
    path.write_bytes("\r\n".join(blocks).encode("ascii"))
    return path


def write_matlab(folder: Path, recording: Recording) -> Path:
    """Write a MATLAB 5 file: x (Hz), amp_x, amp_y, amp_z (points x F, complex), usd (its unit), xyz (m)."""
    from scipy.io import savemat

    export, stream = _exported(recording, folder), io.BytesIO()
    spectra = {f"amp_{axis}": export.velocity[:, k].astype(np.complex64) for k, axis in enumerate("xyz")}
    unit = {"YUnit": "m/s", "PowerSignal": 0.0}
    names = {"x": export.freq_hz[None], **spectra, "usd": unit, "xyz": export.places_mm * 1e-3}
    savemat(stream, names, do_compression=True)
    head = f"MATLAB 5.0 MAT-file, Platform: simulated, Created on: {_DATE}".encode()
    path = folder / "scan.mat"
    path.write_bytes(head.ljust(116) + stream.getvalue()[116:])
    return path


def write_wide(folder: Path, recording: Recording) -> Path:
    """Write a table with one row a frequency and two columns a beam, mm/s and degrees."""
    export = _exported(recording, folder)
    names = [
        f"P{number} V{axis} {part}"
        for number in range(1, len(export.velocity) + 1)
        for axis in "xyz"
        for part in ("Mag [mm/s]", "Phase [deg]")
    ]
    lines = [",".join(["Frequency [Hz]", *names])]
    flat = export.velocity.reshape(-1, len(export.freq_hz)).T
    for freq, values in zip(export.freq_hz, flat, strict=True):
        cells = [f"{abs(v) * 1e3:.5g},{np.degrees(np.angle(v)):.2f}" for v in values]
        lines.append(",".join([f"{freq:.8g}", *cells]))
    path = folder / "wide.csv"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path
