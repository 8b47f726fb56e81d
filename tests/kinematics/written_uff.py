"""Universal files written byte for byte as the format describes them; nothing of the reader is used here."""

from __future__ import annotations

import numpy as np

RULE = "    -1"
DISPLACEMENT, VELOCITY, ACCELERATION, FORCE, PRESSURE = 8, 11, 12, 13, 15
FRF, COHERENCE, SPECTRUM, AUTO, CROSS, TIME = 4, 6, 12, 2, 3, 1


def dataset(number, lines):
    """One dataset of text between its two rules."""
    return "\n".join([RULE, f"{number:6d}", *lines, RULE, ""]).encode("latin-1")


def units(factor=1.0, code=1, name="SI: Meter (newton)"):
    """Dataset 164: SI = file value / factor."""
    numbers = "".join(f"{value:25.16E}".replace("E", "D") for value in (factor, 1.0, 1.0))
    return dataset(164, [f"{code:10d}{name:<20s}{2:10d}", numbers, f"{273.15:25.16E}".replace("E", "D")])


def nodes_15(places, defined=0, measured=0):
    """Dataset 15: format 4I10,1P3E13.5."""
    return dataset(
        15,
        [
            f"{label:10d}{defined:10d}{measured:10d}{11:10d}" + "".join(f"{v:13.5E}" for v in place)
            for label, place in places.items()
        ],
    )


def nodes_2411(places, measured=0):
    """Dataset 2411: format 4I10 and 1P3D25.16."""
    lines = []
    for label, place in places.items():
        lines.append(f"{label:10d}{0:10d}{measured:10d}{11:10d}")
        lines.append("".join(f"{v:25.16E}".replace("E", "D") for v in place))
    return dataset(2411, lines)


def system_18(label, origin, on_x, on_xz, shape=0, parent=0):
    """Dataset 18: origin, a point on +x and one in +xz, in the parent system."""
    numbers = [*origin, *on_x, *on_xz]
    text = [f"{value:13.5E}" for value in numbers]
    return dataset(
        18,
        [f"{label:10d}{shape:10d}{parent:10d}{8:10d}{1:10d}", "SYS", "".join(text[:6]), "".join(text[6:])],
    )


def system_2420(label, rows, origin, shape=0):
    """Dataset 2420: axes in three rows and the origin in the fourth."""
    lines = [f"{1:10d}", "Part", f"{label:10d}{shape:10d}{8:10d}", "CS"]
    for row in (*rows, origin):
        lines.append("".join(f"{value:25.16E}".replace("E", "D") for value in row))
    return dataset(2420, lines)


def function(
    x,
    y,
    node=1,
    direction=3,
    *,
    kind=FRF,
    quantity=VELOCITY,
    unit="m/s",
    per=0,
    per_unit="NONE",
    reference=(0, 0),
    names=("Response", "Vib  Geschwindigkeit"),
    entity="NONE",
    form=5,
    even=True,
    binary="",
    load_case=0,
    version=1,
    abscissa=18,
    said_bytes=None,
    said_count=None,
    step=None,
):
    """Dataset 58 in one of its eight forms, or 58b with ``binary`` ``<`` or ``>``.

    Parameters
    ----------
    form : int
        2, 4 real in single, double precision; 5, 6 complex.
    said_bytes, said_count : int, optional
        What the header says instead of the truth.
    """
    x, y = np.asarray(x, dtype=float), np.asarray(y)
    start, increment = (x[0], (x[1] - x[0]) if step is None else step) if even else (0.0, 0.0)
    count = len(x) if said_count is None else said_count
    axis, per_axis = ("Time", "s") if abscissa == 17 else ("Frequency", "Hz")
    head = [
        *names,
        "21-Nov-26 12:00:00",
        "NONE",
        "NONE",
        f"{kind:5d}{1:10d}{version:5d}{load_case:10d} {entity:<10s}{node:10d}{direction:4d}"
        f" {'NONE':<10s}{reference[0]:10d}{reference[1]:4d}",
        f"{form:10d}{count:10d}{int(even):10d}{start:13.5E}{increment:13.5E}{0.0:13.5E}",
        f"{abscissa:10d}{0:5d}{0:5d}{0:5d} {axis:<20s} {per_axis:<20s}",
        f"{quantity:10d}{0:5d}{0:5d}{0:5d} {'Velocity':>20s} {unit:>20s}",
        f"{per:10d}{0:5d}{0:5d}{0:5d} {'NONE':<20s} {per_unit:<20s}",
        f"{0:10d}{0:5d}{0:5d}{0:5d} {'NONE':<20s} {'NONE':<20s}",
    ]
    columns = [] if even else [x]
    columns += [y.real, y.imag] if form in (5, 6) else [y.real]
    if binary:
        return _binary(head, columns, form, even, binary, said_bytes)
    return dataset(58, [*head, *_text(columns, form, even)])


def _text(columns, form, even):
    """Record 12 as text: 6E13.5, 4E20.12, 2(E13.5,E20.12) or E13.5,2E20.12."""
    numbers = np.column_stack(columns)
    if form in (2, 5):
        words = [f"{value:13.5E}" for value in numbers.ravel()]
        width = 6
    elif even:
        words = [f"{value:20.12E}" for value in numbers.ravel()]
        width = 4
    else:
        words = [f"{row[0]:13.5E}" + "".join(f"{value:20.12E}" for value in row[1:]) for row in numbers]
        width = 2 if form == 4 else 1
    return ["".join(words[place : place + width]) for place in range(0, len(words), width)]


def _binary(head, columns, form, even, mark, said_bytes):
    value = f"{mark}f{4 if form in (2, 5) else 8}"
    if even:
        data = np.column_stack(columns).astype(value).tobytes()
    else:
        layout = np.dtype([("x", f"{mark}f4"), ("y", value, (len(columns) - 1,))])
        rows = np.zeros(len(columns[0]), layout)
        rows["x"], rows["y"] = columns[0], np.column_stack(columns[1:])
        data = rows.tobytes()
    size = len(data) if said_bytes is None else said_bytes
    order = 1 if mark == "<" else 2
    first = f"{58:6d}b{order:6d}{2:6d}{11:12d}{size:12d}{0:6d}{0:6d}{0:12d}{0:12d}"
    text = "\n".join([RULE, first, *head, ""]).encode("latin-1")
    return text + data + f"{RULE}\n".encode()
