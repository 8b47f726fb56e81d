"""Text exports of a scanning vibrometer in the layouts that programs which read them expect."""

from __future__ import annotations

import numpy as np


def fastscan(
    freq,
    points,
    values,
    unit="m/s",
    signal="Velocity",
    place_unit="",
    treated="No",
    encoding="utf-8",
    comma=False,
):
    """One frequency: ``points`` (n, 3) numbered from 1, ``values`` (n, 3) or (n,) complex."""
    values = np.asarray(values)
    axes = [f" {axis}" for axis in "XYZ"] if values.ndim == 2 else [""]
    values = values.reshape(len(values), -1)
    place = f" [{place_unit}]" if place_unit else ""
    names = ["Index", *(f"{axis}{place}" for axis in "XYZ")]
    names += [f"{part}{axis} [{unit}]" for part in ("Real", "Imaginary") for axis in axes]
    lines = [
        "Source File Name:\tear.svd",
        f"Signal: FFT - Vib 3D {signal} - Real & Imag.",
        "",
        "Band No.:\t 1",
        f"Frequency:\t{freq:.10g} Hz",
        "",
        "",
        f"Interpolated:\t{treated}",
        f"Filtered:\t{treated}",
        "",
        "\t".join(names),
    ]
    for number, (point, value) in enumerate(zip(points, values, strict=True), 1):
        cells = [str(number), *(f"{x:.9g}" for x in (*point, *value.real, *value.imag))]
        lines.append("\t".join(cells))
    text = "\r\n".join(lines) + "\r\n"
    return (text.replace(".", ",") if comma else text).encode(encoding)


def point(
    number,
    freq,
    values,
    unit="m/s",
    place=None,
    component="X",
    signal="FFT - Vib Velocity - Real & Imag.",
    names=("Real", "Imaginary"),
    source="ear.svd",
    first=("Frequency", "Hz"),
):
    """One point: ``values`` (f,) complex, or (f, 3) with the axes in the names of the columns."""
    values = np.asarray(values)
    axes = [f" {axis}" for axis in "XYZ"] if values.ndim == 2 else [""]
    values = values.reshape(len(values), -1)
    where = "" if place is None else "  x = {:.9g}  y = {:.9g}  z = {:.9g}".format(*place)
    columns = [f"{name}{axis}" for name in names for axis in axes]
    units = [unit] * len(columns)
    parts = [values.real, values.imag]
    if names[-1] == "Phase":
        units[len(axes) :] = ["\N{DEGREE SIGN}"] * len(axes)
        parts = [np.abs(values), np.angle(values, deg=True)]
    if len(names) == 1:
        parts = parts[:1]
    lines = [
        f"Source File Name:\t{source}",
        f"Point Index:\t{number}{where}",
        f"Component:\t{component}",
        f"Signal:\t{signal}",
        "",
        "\t".join([first[0], *columns]),
        "\t".join(f"[ {unit} ]" for unit in (first[1], *units)),
    ]
    rows = np.column_stack([freq, *parts])
    lines += ["\t".join(f"{value:.9g}" for value in row) for row in rows]
    return ("\r\n".join(lines) + "\r\n").encode("latin-1")
