"""The measurement of a study as other programs export it: universal file, PSV text, MATLAB file, wide table.

Velocities along x, y, z of the vibrometer, computed from the three beams of each point, as a 3D scanning
vibrometer exports them; points are numbered through both bodies. Simulated, like what it is made from.
"""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sample_volumes.vibrometer import Recording

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
_DATE = "21-Nov-26 12:00:00"


def write_exports(folder: Path, recording: Recording) -> None:
    """Write the first run of a recording into a folder, once in each format.

    Parameters
    ----------
    folder : Path
        Made when missing.
    recording : Recording
        Three beams a point, one after the other.
    """
    folder.mkdir(exist_ok=True)
    first = range(0, len(recording.point), 3)
    bodies = [recording.body[k] for k in first]
    places_mm = np.round(recording.position_mm[::3], 4)
    velocity = np.array(
        [np.linalg.solve(recording.direction[k : k + 3], recording.velocity_m_s[0, k : k + 3]) for k in first]
    )
    freq = recording.freq_hz[0] + _step(recording.freq_hz) * np.arange(len(recording.freq_hz))
    rows = [
        f"{body},{number}," + ",".join(f"{v:.4f}" for v in place) + ",0.01"
        for number, (body, place) in enumerate(zip(bodies, places_mm, strict=True), 1)
    ]
    text = "\n".join(["body,point,x_mm,y_mm,z_mm,sd_mm", *rows]) + "\n"
    (folder / "points.csv").write_text(text, encoding="utf-8")
    (folder / "scan.uff").write_bytes(universal_file(freq, places_mm, velocity))
    (folder / "fastscan.txt").write_bytes(fastscan(freq, places_mm, velocity))
    (folder / "scan.mat").write_bytes(matlab_file(freq, places_mm, velocity))
    (folder / "wide.csv").write_text(wide_table(freq, velocity), encoding="utf-8")


def _step(freq_hz: Array) -> float:
    """Return the spacing of lines with the six digits that universal files hold."""
    return float(f"{freq_hz[1] - freq_hz[0]:.5e}")


def universal_file(freq_hz: Array, places_mm: Array, velocity: ComplexArray) -> bytes:
    """Return datasets 164 (units), 15 (nodes, mm) and 58b (spectra of velocity, m/s, single precision)."""
    numbers = "".join(f"{value:25.16E}".replace("E", "D") for value in (1000.0, 1.0, 1.0))
    units = [f"{5:10d}{'mm (milli newton)':<20s}{2:10d}", numbers, f"{273.15:25.16E}".replace("E", "D")]
    nodes = [
        f"{number:10d}{0:10d}{0:10d}{11:10d}" + "".join(f"{v:13.5E}" for v in place)
        for number, place in enumerate(places_mm, 1)
    ]
    parts = [_text_dataset(164, units), _text_dataset(15, nodes)]
    for number, point in enumerate(velocity, 1):
        parts += [_spectrum(freq_hz, values, number, axis) for axis, values in enumerate(point, 1)]
    return b"".join(parts)


def _text_dataset(number: int, lines: list[str]) -> bytes:
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


def fastscan(freq_hz: Array, places_mm: Array, velocity: ComplexArray) -> bytes:
    """Return the blocks of a FastScan export, one a frequency; positions in metres, without their unit."""
    blocks = []
    for line, freq in enumerate(freq_hz):
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
        for number, (place, value) in enumerate(zip(places_mm * 1e-3, velocity[:, :, line], strict=True), 1):
            cells = [f"{v:.7f}" for v in place] + [f"{v:.4e}" for v in (*value.real, *value.imag)]
            lines.append("\t".join([str(number), *cells]))
        blocks.append("\r\n".join(lines) + "\r\n")
    return "\r\n".join(blocks).encode("ascii")


def matlab_file(freq_hz: Array, places_mm: Array, velocity: ComplexArray) -> bytes:
    """Return x (Hz), amp_x, amp_y, amp_z (points x F, complex), usd (its unit) and xyz (m), version 5."""
    from scipy.io import savemat

    stream = io.BytesIO()
    spectra = {f"amp_{axis}": velocity[:, k].astype(np.complex64) for k, axis in enumerate("xyz")}
    names = {
        "x": freq_hz[None],
        **spectra,
        "usd": {"YUnit": "m/s", "PowerSignal": 0.0},
        "xyz": places_mm * 1e-3,
    }
    savemat(stream, names, do_compression=True)
    content = stream.getvalue()
    head = f"MATLAB 5.0 MAT-file, Platform: simulated, Created on: {_DATE}".encode()
    return head.ljust(116) + content[116:]


def wide_table(freq_hz: Array, velocity: ComplexArray) -> str:
    """Return a table with one row a frequency and two columns a beam, mm/s and degrees."""
    names = [
        f"P{number} V{axis} {part}"
        for number in range(1, len(velocity) + 1)
        for axis in "xyz"
        for part in ("Mag [mm/s]", "Phase [deg]")
    ]
    lines = [",".join(["Frequency [Hz]", *names])]
    flat = velocity.reshape(-1, len(freq_hz)).T
    for freq, values in zip(freq_hz, flat, strict=True):
        cells = [f"{abs(v) * 1e3:.5g},{np.degrees(np.angle(v)):.2f}" for v in values]
        lines.append(",".join([f"{freq:.8g}", *cells]))
    return "\n".join(lines) + "\n"
