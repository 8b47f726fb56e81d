"""One recording in every format of the table: a new entry needs its writer here."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from legacy.kinematics.readers.hdf5 import write_hdf5
from legacy.kinematics.readers.input_options import InputOptions, SeriesOptions
from legacy.kinematics.readers.proprietary_formats import COMPOUND
from sample_volumes import exports
from tests.kinematics import written_psv

FREQ_HZ = np.array([400.0, 650.0, 900.0, 1150.0])
PLACES_MM = np.array([[1.2, 0.1, 0.0], [-1.1, 0.2, 0.3], [0.4, 3.0, -0.5]])
_RNG = np.random.default_rng(8)
# Of each point (3,) along x, y and z (3,), m/s.
VELOCITY = 1e-4 * (_RNG.normal(size=(3, 3, 4)) + 1j * _RNG.normal(size=(3, 3, 4)))
_SECONDS, _RATE_HZ = 0.6, 8000.0


def _bytes(name: str, content: Callable[[], bytes | str]) -> Callable[[Path], tuple[Path, InputOptions]]:
    def write(folder: Path) -> tuple[Path, InputOptions]:
        data, path = content(), folder / name
        path.write_bytes(data if isinstance(data, bytes) else data.encode())
        return path, InputOptions()

    return write


def _hdf5(folder: Path) -> tuple[Path, InputOptions]:
    beams, places = np.tile(np.eye(3), (3, 1)), np.repeat(PLACES_MM, 3, axis=0)
    points = [str(1 + k // 3) for k in range(9)]
    named = {"point": points, "direction": beams, "unit": "m/s", "body": "stapes", "position_mm": places}
    write_hdf5(folder / "a.h5", FREQ_HZ, VELOCITY.reshape(9, -1), **named)
    return folder / "a.h5", InputOptions()


def _points(folder: Path) -> tuple[Path, InputOptions]:
    for number, (place, value) in enumerate(zip(PLACES_MM, VELOCITY, strict=True), 1):
        content = written_psv.point(number, FREQ_HZ, value.T, place=place)
        (folder / f"{number}.txt").write_bytes(content if isinstance(content, bytes) else content.encode())
    return folder, InputOptions()


def _series(folder: Path) -> tuple[Path, InputOptions]:
    """Sines at the lines of the recording, driven by 1 V each."""
    time = np.arange(int(_SECONDS * _RATE_HZ)) / _RATE_HZ
    turning = np.exp(2j * np.pi * FREQ_HZ[:, None] * time)
    drive = np.sum(turning.real, axis=0)
    signals = {f"c{k}": (value @ turning).real for k, value in enumerate(VELOCITY.reshape(9, -1))}
    np.savez(folder / "a.npz", time_s=time, drive=drive, **signals)
    rows = ["channel,role,body,point,dir_x,dir_y,dir_z,unit,x_mm,y_mm,z_mm", "drive,reference,,,,,,V,,,"]
    for k in range(9):
        beam, place = ",".join(f"{v:g}" for v in np.eye(3)[k % 3]), ",".join(map(str, PLACES_MM[k // 3]))
        rows.append(f"c{k},response,stapes,{1 + k // 3},{beam},m/s,{place}")
    (folder / "channels.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
    options = SeriesOptions(folder / "channels.csv", window="none", overlap=0.0, averages=3)
    return folder / "a.npz", InputOptions(series=options)


def _tidy() -> str:
    rows = ["body,point,x_mm,y_mm,z_mm,dir_x,dir_y,dir_z,freq_hz,re_m_s,im_m_s"]
    for point, (place, values) in enumerate(zip(PLACES_MM, VELOCITY, strict=True), 1):
        for beam, line in zip(np.eye(3), values, strict=True):
            where = ",".join(f"{v:g}" for v in (*place, *beam))
            rows += [
                f"stapes,{point},{where},{freq:g},{v.real:.12g},{v.imag:.12g}"
                for freq, v in zip(FREQ_HZ, line, strict=True)
            ]
    return "\n".join(rows) + "\n"


# By the name of the entry; each writes into a folder and returns the file and what has to be said of it.
CASES: dict[str, Callable[[Path], tuple[Path, InputOptions]]] = {
    "vendor": _bytes("a.svd", lambda: COMPOUND + bytes(64)),
    "matlab": _bytes("a.mat", lambda: exports.matlab_file(FREQ_HZ, PLACES_MM, VELOCITY)),
    "hdf5": _hdf5,
    "uff": _bytes("a.uff", lambda: exports.universal_file(FREQ_HZ, PLACES_MM, VELOCITY)),
    "fastscan": _bytes("a.txt", lambda: exports.fastscan(FREQ_HZ, PLACES_MM, VELOCITY)),
    "points": _points,
    "time": _series,
    "wide": _bytes("a.csv", lambda: exports.wide_table(FREQ_HZ, VELOCITY)),
    "tidy": _bytes("a.csv", _tidy),
}
