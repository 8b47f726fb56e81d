"""Small sound files of every vibrometer format, and the words by which points2dof reads them."""

from __future__ import annotations

import io
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from scipy.io import savemat, wavfile

from tests.kinematics import written_uff as uff
from tests.kinematics.written_csv import plain
from tests.kinematics.written_mat import write_v73
from tests.kinematics.written_psv import fastscan, point

FREQ = np.arange(1, 13) * 12.5
_LINES, _POINTS, _SAMPLES, _RATE = len(FREQ), 3, 400, 2000.0
_RNG = np.random.default_rng(0)
_VALUE = _RNG.normal(size=(_POINTS, _LINES, 2)) @ [1.0, 1.0j]
_PLACES = np.eye(3) * 1e-3
_COHERENCE = {"kind": uff.COHERENCE, "quantity": 1, "unit": "NONE", "form": 2}
_TIME = np.arange(_SAMPLES) / _RATE
_DRIVE = _RNG.standard_normal(_SAMPLES)
_CHANNELS = b"channel,role,body,point,dir,unit\nvib,response,stapes,1,z,mm/s\nref,reference,,,,V\n"
_PLACED = ("--points", "points.csv")
_MAPPING = (
    b'frequency = "f [Hz]"\n[[signal]]\nmagnitude = "P{point} Vz Mag [mm/s]"\n'
    b'phase = "P{point} Vz Phase [deg]"\nunit = "mm/s"\ndirection = "z"\nbody = "stapes"\n'
)
_SERIES = ("--channels", "channels.csv", *_PLACED)


@dataclass(frozen=True)
class Sound:
    """A measurement that is read.

    Attributes
    ----------
    files : mapping of str to bytes
    words : tuple of str
        As of points2dof.
    target : str
        Name of the file or folder that is damaged.
    """

    files: Mapping[str, bytes]
    words: tuple[str, ...]
    target: str


@cache
def sound() -> dict[str, Sound]:
    """Make one measurement of every format."""
    return {
        "tidy": Sound(
            {"ldv.csv": plain().encode(), "points.csv": _points(), "fiducials.csv": _fiducials()},
            ("ldv.csv", "--fiducials", "fiducials.csv"),
            "ldv.csv",
        ),
        "text.uff": _single("ldv.uff", b"".join(_uff_text())),
        "binary.uff": _single("ldv.uff", b"".join(_uff_binary())),
        "uneven.uff": _placed(
            "ldv.uff",
            uff.function(FREQ, _VALUE[0], 1, form=6, even=False, binary=">")
            + uff.function(FREQ, _VALUE[1], 2, form=6, even=False),
        ),
        "series.uff": _single("ldv.uff", b"".join(_uff_series())),
        "fastscan": Sound(
            {f"scan/{hz:g}.txt": fastscan(hz, _PLACES, _VALUE[:, k].repeat(3).reshape(3, 3)) for k, hz in
             enumerate(FREQ[:3])},
            ("scan", "--body", "stapes=scan"),
            "scan/12.5.txt",
        ),
        "point.txt": _single("ldv.txt", point(1, FREQ, _VALUE[0], place=(1, 2, 3))),
        "axes.txt": _placed("ldv.txt", point(1, FREQ, np.stack([_VALUE[0]] * 3, 1), component="3D")),
        "v5.mat": _single("ldv.mat", _mat5(False)),
        "packed.mat": _single("ldv.mat", _mat5(True)),
        "v4.mat": Sound(
            {"ldv.mat": _mat4()},
            ("ldv.mat", "--body", "stapes=ldv.mat", "--beam", "z", "--dof", "z"),
            "ldv.mat",
        ),
        "v73.mat": _single("ldv.mat", _written(lambda path: write_v73(path, _variables()))),
        "own.h5": Sound({"ldv.h5": _written(_own_h5)}, ("ldv.h5",), "ldv.h5"),
        "wide.csv": _placed("ldv.csv", _wide()),
        "mapped.csv": Sound(
            {"ldv.csv": _wide(), "ldv.csv.toml": _MAPPING, "points.csv": _points()},
            ("ldv.csv", *_PLACED),
            "ldv.csv",
        ),
        "series.csv": _series("ldv.csv", _series_csv()),
        "series.npz": _series("ldv.npz", _npz()),
        "series.wav": _series(
            "ldv.wav", _wav(), _CHANNELS.replace(b"vib", b"1").replace(b"\nref", b"\n2")
        ),
        "series.h5": _series("ldv.h5", _written(_series_h5)),
    }  # fmt: skip


def _single(name: str, content: bytes) -> Sound:
    return Sound({name: content}, (name, "--body", f"stapes={name}"), name)


def _placed(name: str, content: bytes) -> Sound:
    words = (name, "--body", f"stapes={name}", *_PLACED)
    return Sound({name: content, "points.csv": _points()}, words, name)


def _series(name: str, content: bytes, channels: bytes = _CHANNELS) -> Sound:
    files = {name: content, "channels.csv": channels, "points.csv": _points()}
    return Sound(files, (name, *_SERIES), name)


def _points() -> bytes:
    rows = [f"{body},{k},{0.5 * k},0.25,{z}" for body, z in (("stapes", 0.0), ("base", -1.5)) for k in (1, 2)]
    return ("body,point,x_mm,y_mm,z_mm\n" + "\n".join(rows) + "\n").encode()


def _fiducials() -> bytes:
    places = ((0, 0, 0), (1, 0, 0), (0, 2, 0), (0, 0, 3), (1, 1, 1))
    rows = [f"f{k},{x},{y},{z},{x + 1},{y},{z},footplate" for k, (x, y, z) in enumerate(places)]
    return ("name,x_mm,y_mm,z_mm,x_ref_mm,y_ref_mm,z_ref_mm,frame\n" + "\n".join(rows) + "\n").encode()


def _uff_text() -> list[bytes]:
    return [
        uff.units(),
        uff.nodes_15({1: (0, 0, 0), 2: (1e-3, 0, 0)}, 3, 3),
        uff.system_18(3, (0, 0, 0), (1, 0, 0), (0, 0, 1)),
        uff.function(FREQ, _VALUE[0], 1),
        uff.function(FREQ, _VALUE[1], 2, form=6),
    ]


def _uff_binary() -> list[bytes]:
    return [
        uff.units(1000.0, 5, "mm"),
        uff.nodes_2411({1: (0, 0, 0)}, 3),
        uff.system_2420(3, np.eye(3), (0, 0, 0)),
        uff.function(FREQ, _VALUE[0], 1, form=6, binary="<"),
        uff.function(FREQ, abs(_VALUE[0]) * 0.1, 1, **_COHERENCE),
    ]


def _uff_series() -> list[bytes]:
    kind = {"kind": uff.TIME, "abscissa": 17, "form": 4}
    return [
        uff.units(),
        uff.nodes_15({1: (0, 0, 0)}),
        uff.function(_TIME, 2.0 * _DRIVE, 1, **kind),
        uff.function(_TIME, _DRIVE, 0, quantity=uff.FORCE, unit="N", **kind),
    ]


def _variables() -> dict[str, Any]:
    usd = {
        "Name": "Velocity",
        "Complex": 1.0,
        "PowerSignal": 0.0,
        "Is3D": 0.0,
        "ResponseDOFs": {"Direction": "ptcPlusZTranslation", "Quantity": "Velocity"},
        "XUnit": "Hz",
        "YUnit": "m/s",
    }
    return {"x": FREQ[None], "y": _VALUE, "usd": usd, "xyz": _PLACES}


def _mat5(packed: bool) -> bytes:
    stream = io.BytesIO()
    savemat(stream, {**_variables(), "names": np.array([["a", "b"]], dtype=object)}, do_compression=packed)
    return stream.getvalue()


def _mat4() -> bytes:
    stream = io.BytesIO()
    savemat(stream, {"x": FREQ[None], "y": _VALUE, "unit": "m/s", "xyz": _PLACES}, format="4")
    return stream.getvalue()


def _written(write: Any) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.h5"
        write(path)
        return path.read_bytes()


def _own_h5(path: Path) -> None:
    from legacy.kinematics.readers.hdf5 import write_hdf5

    write_hdf5(
        path,
        FREQ,
        _VALUE,
        point=("1", "2", "3"),
        direction=np.eye(3),
        unit="m/s",
        body="stapes",
        position_mm=_PLACES * 1e3,
        sd=np.full(_POINTS, 1e-3),
    )


def _series_h5(path: Path) -> None:
    import h5py

    with h5py.File(path, "w") as file:
        file.attrs["fs"] = _RATE
        file["vib"] = 2.0 * _DRIVE[:, None]
        file.create_dataset("ref", data=_DRIVE, chunks=(100,), compression="gzip", shuffle=True)


def _wide() -> bytes:
    names = [f"P{point} Vz {part}" for point in (1, 2) for part in ("Mag [mm/s]", "Phase [deg]")]
    values = [part for one in _VALUE[:2] for part in (np.abs(one), np.degrees(np.angle(one)))]
    rows = [",".join(f"{v:.9g}" for v in row) for row in zip(FREQ, *values, strict=True)]
    return "\n".join([",".join(["f [Hz]", *names]), *rows, ""]).encode()


def _series_csv() -> bytes:
    rows = "\n".join(f"{t:.9g},{2 * b:.9g},{b:.9g}" for t, b in zip(_TIME, _DRIVE, strict=True))
    return f"time_s,vib,ref\n{rows}\n".encode()


def _npz() -> bytes:
    stream = io.BytesIO()
    np.savez_compressed(stream, vib=2.0 * _DRIVE, ref=_DRIVE, time_s=_TIME)
    return stream.getvalue()


def _wav() -> bytes:
    stream = io.BytesIO()
    wavfile.write(stream, int(_RATE), (np.column_stack([_DRIVE, _DRIVE]) * 4000).astype(np.int16))
    return stream.getvalue()
