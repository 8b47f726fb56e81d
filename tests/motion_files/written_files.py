"""Vibrometer files of every format, written as the formats describe them, without the readers."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
from scipy.io import savemat

from kinematics.readers.stated_by_user import FileFacts

FREQ_HZ = np.array([400.0, 650.0, 900.0, 1150.0])
PLACES_M = 1e-3 * np.array([[1.2, 0.1, 0.0], [-1.1, 0.2, 0.3], [0.4, 3.0, -0.5]])
_RNG = np.random.default_rng(8)
# (point, axis, freq), m/s
VELOCITY = 1e-4 * (_RNG.normal(size=(3, 3, 4)) + 1j * _RNG.normal(size=(3, 3, 4)))
RULE = "    -1"
DISPLACEMENT, VELOCITIES, FORCE = 8, 11, 13
FRF, COHERENCE, SPECTRUM, TIME = 4, 6, 12, 1


def dataset(number, lines):
    """One dataset of a universal file between its two rules."""
    return "\n".join([RULE, f"{number:6d}", *lines, RULE, ""]).encode("latin-1")


def units(factor=1.0):
    """Dataset 164: SI = file value / factor."""
    numbers = "".join(f"{value:25.16E}".replace("E", "D") for value in (factor, 1.0, 1.0))
    head = f"{1:10d}{'SI: Meter (newton)':<20s}{2:10d}"
    return dataset(164, [head, numbers, f"{273.15:25.16E}".replace("E", "D")])


def nodes_15(places, defined=0, measured=0):
    """Dataset 15: format 4I10,1P3E13.5."""
    rows = [
        f"{label:10d}{defined:10d}{measured:10d}{11:10d}" + "".join(f"{v:13.5E}" for v in place)
        for label, place in places.items()
    ]
    return dataset(15, rows)


def nodes_2411(places, measured=0):
    """Dataset 2411: format 4I10 and 1P3D25.16."""
    lines = []
    for label, place in places.items():
        lines.append(f"{label:10d}{0:10d}{measured:10d}{11:10d}")
        lines.append("".join(f"{v:25.16E}".replace("E", "D") for v in place))
    return dataset(2411, lines)


def system_18(label, origin, on_x, on_xz, shape=0, parent=0):
    """Dataset 18: origin, a point on +x and one in +xz."""
    text = [f"{value:13.5E}" for value in (*origin, *on_x, *on_xz)]
    head = f"{label:10d}{shape:10d}{parent:10d}{8:10d}{1:10d}"
    return dataset(18, [head, "SYS", "".join(text[:6]), "".join(text[6:])])


def system_2420(label, turn, origin):
    """Dataset 2420: axes in rows and the origin, format 1P3D25.16."""
    rows = ["".join(f"{v:25.16E}".replace("E", "D") for v in row) for row in (*turn, origin)]
    return dataset(2420, [f"{1:10d}", "part", f"{label:10d}{0:10d}{8:10d}", "SYS", *rows])


def function(
    x, y, node=1, direction=3, *, kind=FRF, quantity=VELOCITIES, unit="m/s", per=0, per_unit="NONE",
    reference=(0, 0), names=("Response", "Vib  Geschwindigkeit"), form=6, even=True, binary="", load_case=0,
    version=1, abscissa=18, count=None,
):  # fmt: skip
    """Dataset 58 in one of its eight forms, or 58b with ``binary`` ``<`` or ``>``; ``count`` may lie."""
    x, y = np.asarray(x, dtype=float), np.asarray(y)
    start, step = (x[0], x[1] - x[0]) if even else (0.0, 0.0)
    count = len(x) if count is None else count
    head = [
        *names, "21-Nov-26 12:00:00", "NONE", "NONE",
        f"{kind:5d}{1:10d}{version:5d}{load_case:10d} {'NONE':<10s}{node:10d}{direction:4d}"
        f" {'NONE':<10s}{reference[0]:10d}{reference[1]:4d}",
        f"{form:10d}{count:10d}{int(even):10d}{start:13.5E}{step:13.5E}{0.0:13.5E}",
        f"{abscissa:10d}{0:5d}{0:5d}{0:5d} {'Frequency':<20s} {'Hz':<20s}",
        f"{quantity:10d}{0:5d}{0:5d}{0:5d} {'Velocity':>20s} {unit:>20s}",
        f"{per:10d}{0:5d}{0:5d}{0:5d} {'NONE':<20s} {per_unit:<20s}",
        f"{0:10d}{0:5d}{0:5d}{0:5d} {'NONE':<20s} {'NONE':<20s}",
    ]  # fmt: skip
    columns = [*([] if even else [x]), y.real, *([y.imag] if form in (5, 6) else [])]
    numbers = np.column_stack(columns)
    if binary:
        data = numbers.astype(f"{binary}f{4 if form in (2, 5) else 8}").tobytes()
        order = 1 if binary == "<" else 2
        first = f"{58:6d}b{order:6d}{2:6d}{11:12d}{len(data):12d}{0:6d}{0:6d}{0:12d}{0:12d}"
        return "\n".join([RULE, first, *head, ""]).encode("latin-1") + data + f"{RULE}\n".encode()
    if form in (2, 5):
        words, width = [f"{value:13.5E}" for value in numbers.ravel()], 6
    elif even:
        words, width = [f"{value:20.12E}" for value in numbers.ravel()], 4
    else:
        words = [f"{row[0]:13.5E}" + "".join(f"{value:20.12E}" for value in row[1:]) for row in numbers]
        width = 2 if form == 4 else 1
    return dataset(58, [*head, *("".join(words[k : k + width]) for k in range(0, len(words), width))])


def universal_file(**how):
    """The recording as a universal file of responses, with nodes in metres."""
    places = dict(enumerate(PLACES_M.tolist(), 1))
    functions = [
        function(FREQ_HZ, VELOCITY[point, axis], point + 1, axis + 1, kind=SPECTRUM, **how)
        for point in range(3)
        for axis in range(3)
    ]
    return b"".join([units(), nodes_2411(places), *functions])


def fastscan(freq, places, values, unit="m/s", treated="No", comma=False):
    """One frequency of a FastScan: ``values`` (n, 3) complex."""
    names = ["Index", "X", "Y", "Z", *(f"{p} {a} [{unit}]" for p in ("Real", "Imaginary") for a in "XYZ")]
    lines = [
        "Source File Name:\tear.svd", "Signal: FFT - Vib 3D Velocity - Real & Imag.", "", "Band No.:\t 1",
        f"Frequency:\t{freq:.10g} Hz", "", "", f"Interpolated:\t{treated}", f"Filtered:\t{treated}", "",
        "\t".join(names),
    ]  # fmt: skip
    for number, (place, value) in enumerate(zip(places, values, strict=True), 1):
        lines.append("\t".join([str(number), *(f"{x:.12g}" for x in (*place, *value.real, *value.imag))]))
    text = "\r\n".join(lines) + "\r\n"
    return (text.replace(".", ",") if comma else text).encode()


def point_block(number, values, place, unit="m/s", source="ear.svd", component="", first="Frequency"):
    """One point of a per-point export: ``values`` (3, f) or (f,) complex."""
    values = np.atleast_2d(values)
    axes = [f" {axis}" for axis in "XYZ"] if len(values) == 3 else [""]
    columns = [f"{part}{axis}" for part in ("Real", "Imaginary") for axis in axes]
    lines = [
        f"Source File Name:\t{source}",
        f"Point Index:\t{number}" + "  x = {:.9g}  y = {:.9g}  z = {:.9g}".format(*place),
        f"Component:\t{component}", "Signal:\tFFT - Vib Velocity - Real & Imag.", "",
        "\t".join([first, *columns]), "\t".join(f"[ {one} ]" for one in ("Hz", *[unit] * len(columns))),
    ]  # fmt: skip
    rows = np.column_stack([FREQ_HZ, values.real.T, values.imag.T])
    lines += ["\t".join(f"{value:.12g}" for value in row) for row in rows]
    return ("\r\n".join(lines) + "\r\n").encode("latin-1")


def tidy_table(separator=",", decimal=".", head="re_m_s,im_m_s", body="stapes"):
    """The recording as a tidy table."""
    rows = [f"body,point,x_mm,y_mm,z_mm,dir_x,dir_y,dir_z,freq_hz,{head}"]
    for point in range(3):
        for axis in range(3):
            where = ",".join(f"{v:g}" for v in (*(1e3 * PLACES_M[point]), *np.eye(3)[axis]))
            for freq, value in zip(FREQ_HZ, VELOCITY[point, axis], strict=True):
                rows.append(f"{body},{point + 1},{where},{freq:g},{value.real:.15g},{value.imag:.15g}")
    return "\n".join(rows).replace(",", ";").replace(".", decimal).replace(";", separator) + "\n"


def wide_table(separator=",", phase="[deg]", frequency="[Hz]"):
    """The recording as a wide table of magnitudes in mm/s and phases."""
    turn = np.rad2deg(1.0) if "deg" in phase else 1.0
    names, columns = [f"Frequency {frequency}".strip()], [FREQ_HZ / (1e3 if "k" in frequency else 1.0)]
    for point in range(3):
        for axis in range(3):
            names += [
                f"P{point + 1} V{'xyz'[axis]} Mag [mm/s]",
                f"P{point + 1} V{'xyz'[axis]} Phase {phase}".strip(),
            ]
            columns += [1e3 * np.abs(VELOCITY[point, axis]), turn * np.angle(VELOCITY[point, axis])]
    rows = [separator.join(f"{value:.15g}" for value in row) for row in np.column_stack(columns)]
    return "\n".join([separator.join(names), *rows]) + "\n"


def matlab_variables():
    """The variables of a script of File Access: one value a beam."""
    values = {f"amp_{axis}": VELOCITY[:, k] for k, axis in enumerate("xyz")}
    return {"x": FREQ_HZ[None], "usd": {"YUnit": "m/s", "PowerSignal": 0.0}, "xyz": PLACES_M, **values}


def v73(path, variables):
    """A MATLAB 7.3 file: HDF5 behind a user block, dimensions in reverse."""
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, value in variables.items():
            _put(file, name, value)
    with path.open("r+b") as stream:
        stream.write(b"MATLAB 7.3 MAT-file, Platform: PCWIN64".ljust(124) + b"\x00\x02IM")


def _put(group, name, value):
    if isinstance(value, dict):
        inner = group.create_group(name)
        inner.attrs["MATLAB_class"] = np.bytes_("struct")
        for key, one in value.items():
            _put(inner, key, one)
        return
    if isinstance(value, str):
        codes = np.frombuffer(value.encode("utf-16-le"), dtype=np.uint16)[:, None]
        made = group.create_dataset(name, data=codes)
        made.attrs["MATLAB_class"] = np.bytes_("char")
        return
    array = np.atleast_2d(np.asarray(value))
    if np.iscomplexobj(array):
        pairs = np.empty(array.T.shape, dtype=[("real", "<f8"), ("imag", "<f8")])
        pairs["real"], pairs["imag"] = array.T.real, array.T.imag
        made = group.create_dataset(name, data=pairs)
    else:
        made = group.create_dataset(name, data=np.asarray(array, dtype=float).T)
    made.attrs["MATLAB_class"] = np.bytes_("double")


def _bytes(name, content):
    def write(folder):
        path = folder / name
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return path, FileFacts()

    return write


def _matlab(folder):
    savemat(folder / "a.mat", matlab_variables())
    return folder / "a.mat", FileFacts()


def _hdf5(folder):
    value = VELOCITY.reshape(9, -1)
    with h5py.File(folder / "a.h5", "w") as file:
        file.attrs["unit"] = "m/s"
        file.attrs["amplitude"] = "peak"
        file["freq_hz"], file["re"], file["im"] = FREQ_HZ, value.real, value.imag
        file["direction"] = np.tile(np.eye(3), (3, 1))
        file["position_mm"] = 1e3 * np.repeat(PLACES_M, 3, axis=0)
        file["point"] = [str(1 + k // 3) for k in range(9)]
        file["body"] = ["stapes"] * 9
    return folder / "a.h5", FileFacts()


def _points(folder):
    blocks = [point_block(k + 1, VELOCITY[k], PLACES_M[k]) for k in range(3)]
    (folder / "a.txt").write_bytes(b"\r\n".join(blocks))
    return folder / "a.txt", FileFacts()


def _series(folder):
    """Sines at the lines of the recording, driven by 1 V each."""
    time = np.arange(4800) / 8000.0
    turning = np.exp(2j * np.pi * FREQ_HZ[:, None] * time)
    signals = {f"c{k}": (value @ turning).real for k, value in enumerate(VELOCITY.reshape(9, -1))}
    np.savez(folder / "a.npz", time_s=time, drive=np.sum(turning.real, axis=0), **signals)
    rows = ["channel,role,body,point,dir,unit,x_mm,y_mm,z_mm", "drive,reference,,,,V,,,"]
    for k in range(9):
        place = ",".join(f"{1e3 * v:g}" for v in PLACES_M[k // 3])
        rows.append(f"c{k},response,stapes,{1 + k // 3},{'xyz'[k % 3]},m/s,{place}")
    (folder / "channels.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
    return folder / "a.npz", FileFacts(channels=folder / "channels.csv", period_s=0.02)


def _scan_file(folder):
    scan = Path(__file__).parent / "data" / "surface.svd"
    (folder / "a.svd").write_bytes(scan.read_bytes())
    return folder / "a.svd", FileFacts()


WRITERS = {
    "svd": _scan_file,
    "matlab": _matlab,
    "uff": _bytes("a.uff", universal_file()),
    "psv": _bytes(
        "a.txt", b"\r\n".join(fastscan(f, PLACES_M, VELOCITY[:, :, k]) for k, f in enumerate(FREQ_HZ))
    ),
    "series": _series,
    "wide": _bytes("a.csv", wide_table()),
    "tidy": _bytes("a.csv", tidy_table()),
}
OTHERS = {"hdf5": _hdf5, "points": _points}
"""Other layouts of formats."""
"""By the name of the format: writes the recording (a genuine scan for svd) and returns file and facts."""
