"""Time series from CSV, NPZ, WAV, MATLAB and HDF5 files: channels by name, one sampling rate.

* CSV: a column ``time_s``, one column a channel; optional ``freq_hz`` (set frequency of a stepped sine) and
  ``record`` (several records below each other).
* NPZ, MATLAB, HDF5: arrays of samples, or of rows x samples; the longer side is time. The rate is
  ``sample_rate_hz`` (or ``fs``), or follows from ``time_s`` (``time``, ``t``, s). In HDF5 the rate may be an
  attribute of the file. Names with dots reach into structs and groups.
* WAV: channels are named 1, 2, ...; whole numbers are scaled to full scale = 1.
"""

from __future__ import annotations

import warnings
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from legacy.kinematics.errors import KinematicsError
from legacy.kinematics.readers.containers.hdf5_file import is_hdf5
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.faults import Fault, Place, collect_faults, list_some, raise_all
from legacy.stapeskit.units import HIGHEST_HZ, LARGEST

TIMES = ("time_s", "time", "t", "x")
RATES = ("sample_rate_hz", "sample_rate", "fs", "fs_hz")
# Difference of sampling times, in samples, that counts as rounding of written times.
_JITTER = 0.1
# Shorter records hold no spectrum.
_FEWEST = 16


@dataclass(frozen=True)
class Series:
    """The samples of one file.

    Attributes
    ----------
    start_s : float
        Time of the first sample.
    channels : mapping of str to tuple of ndarray, (sample,)
        One array a row or record.
    set_hz : tuple of ndarray, (sample,)
        Set frequency of a stepped sine, one array a record; empty when the file has none.
    """

    file: str
    sample_rate_hz: float
    start_s: float
    channels: Mapping[str, tuple[Array, ...]]
    set_hz: tuple[Array, ...] = ()


def read_series(path: Path, names: Sequence[str]) -> Series:
    """Read the named channels of a file.

    Parameters
    ----------
    names : sequence of str
        As in the channel table; upper and lower case are one when only one name matches.

    Raises
    ------
    KinematicsError
        The file is damaged or of another kind, a channel is missing (those found are listed), times are not
        evenly spaced, or no sampling rate is given.
    """
    path = Path(path)
    if not path.is_file():
        raise KinematicsError.of("the time series", "an existing file", path, "", "Check its name")
    with path.open("rb") as stream:
        head = stream.read(16)
    if head.startswith((b"RIFF", b"RIFX", b"RF64")):
        return _wav(path, names)
    if head.startswith(b"PK\x03\x04"):
        return _of_tree(_npz(path), path.name, names)
    if head.startswith(b"MATLAB"):
        from legacy.kinematics.readers.containers.matlab_file import read_mat

        return _of_tree(read_mat(path), path.name, names)
    if is_hdf5(path):
        from legacy.kinematics.readers.containers.hdf5_file import read_hdf5

        tree = read_hdf5(path, "an HDF5 file", lambda file: _hdf5_tree(file, path.name))
        return _of_tree(tree, path.name, names)
    return _csv(path, names)


def _hdf5_tree(file: Any, where: str) -> dict[str, Any]:
    from legacy.kinematics.readers.hdf5 import plain_tree

    rates = {name: file.attrs[name] for name in RATES if name in file.attrs}
    return {**plain_tree(file, where), **rates}


def _csv(path: Path, names: Sequence[str]) -> Series:
    from legacy.stapeskit.tables.csv_table import read_table

    columns: dict[str, str] = {}

    def choose(header: Sequence[str], file: str) -> tuple[set[str], set[str]]:
        if "time_s" not in header:
            place, step = Place(file, "line", (1,)), "Write the time of every sample, s"
            raise KinematicsError.of("a table of time series", "with a column time_s", "none", place, step)
        columns.update(_match(names, header, file))
        extra = {"time_s", "freq_hz", "record"} & set(header)
        return set(columns.values()) | extra, set()

    table = read_table(path, choose)
    faults = list(table.faults)
    if not len(table):
        raise_all(
            KinematicsError, faults or [Fault("a table of time series", "with rows", "none", path.name)]
        )
    record = table.numbers.get("record", np.zeros(len(table)))
    edges = np.concatenate([[0], np.flatnonzero(np.diff(record) != 0.0) + 1, [len(table)]])
    parts = [slice(int(a), int(b)) for a, b in pairwise(edges)]
    time = table.numbers["time_s"]
    rates: list[float] = []
    for part in parts:
        # Times that are no numbers have been reported.
        if table.faults and not np.all(np.isfinite(time[part])):
            continue
        with collect_faults(faults):
            rates.append(sampling_rate(time[part], table.where(part.start)))
    if rates and max(rates) > min(rates) * (1.0 + 1e-6):
        got = f"{min(rates):g} to {max(rates):g} Hz"
        faults.append(Fault("the sampling rate", "one in all records", got, path.name))
    channels = {
        name: tuple(table.numbers[column][part] for part in parts) for name, column in columns.items()
    }
    if not table.faults:
        with collect_faults(faults):
            check_finite(channels, path.name)
    raise_all(KinematicsError, faults)
    steps = table.numbers.get("freq_hz")
    return Series(
        path.name,
        rates[0],
        float(time[0]),
        channels,
        () if steps is None else tuple(steps[part] for part in parts),
    )


def _match(names: Sequence[str], known: Sequence[str], file: str) -> dict[str, str]:
    """Return the name in the file of every channel."""
    low: dict[str, list[str]] = {}
    for name in known:
        low.setdefault(name.lower(), []).append(name)
    signals, faults = {}, []
    for name in dict.fromkeys(names):
        near = low.get(name.lower(), [])
        if name in known or len(near) == 1:
            signals[name] = name if name in known else near[0]
        else:
            want = f"in the file, which has {list_some(known, 20) or 'none'}"
            faults.append(Fault(f"channel {name}", want, "no such one", file))
    raise_all(KinematicsError, faults)
    return signals


def sampling_rate(time: Array, where: Place | str) -> float:
    """Return the sampling rate, Hz, of evenly spaced times (sample,), s.

    Raises
    ------
    KinematicsError
        Fewer than two times, or such that are not finite, do not ascend, are too close or not evenly spaced.
    """
    if len(time) < 2 or not np.all(np.isfinite(time)) or not time[-1] > time[0]:
        raise KinematicsError.of("time_s", "at least two finite, ascending times", "others", where)
    with np.errstate(over="ignore", invalid="ignore"):
        step = (time[-1] - time[0]) / (len(time) - 1)
        apart = np.arange(len(time), dtype=float)
        apart *= -step
        apart += time
        apart -= time[0]
        np.abs(apart, out=apart)
        apart /= max(step, 1e-300)
    if not 1.0 / HIGHEST_HZ <= step < np.inf:
        got = f"steps of {step:.3g} s"
        raise KinematicsError.of("time_s", f"in s, in steps of {1.0 / HIGHEST_HZ:g} s or more", got, where)
    if not np.max(apart) <= _JITTER:
        worst = int(np.argmax(apart))
        next_step = "Resample the record to even times, or fill the gap"
        got = f"{apart[worst]:.3g} steps off at sample {worst + 1}"
        raise KinematicsError.of("time_s", "evenly spaced", got, where, next_step)
    return float(1.0 / step)


def check_finite(channels: Mapping[str, tuple[Array, ...]], file: str) -> None:
    """Refuse samples that are no finite numbers; channels without any number are left alone.

    Parameters
    ----------
    channels : mapping of str to tuple of ndarray (sample,)
        Records of every channel.

    Raises
    ------
    KinematicsError
        Names every such channel and record.
    """
    faults = []
    for name, rows in channels.items():
        for number, row in enumerate(rows, 1):
            bad = np.flatnonzero(~np.isfinite(row))
            place = f"{file}, {name}" + (f", record {number}" if len(rows) > 1 else "")
            step = "Cut the record, or leave the channel out"
            if len(bad) and len(bad) < len(row):
                got = f"{len(bad)} NaN or infinite ones, the first in sample {bad[0] + 1}"
                faults.append(Fault("the samples", "finite numbers", got, place, step))
            elif len(row) and not len(bad) and max(row.max(), -row.min()) > LARGEST:
                first = int(np.argmax((row > LARGEST) | (row < -LARGEST)))
                got = f"{row[first]:g} in sample {first + 1}"
                faults.append(Fault("the samples", f"below {LARGEST:g}", got, place, step))
    raise_all(KinematicsError, faults)


def _npz(path: Path) -> dict[str, Any]:
    """Read arrays; sizes are checked against the archive before anything is allocated."""
    step = "It is truncated or damaged: save it again"
    tree: dict[str, Any] = {}
    try:
        with zipfile.ZipFile(path) as archive:
            for item in archive.infolist():
                if not item.filename.endswith(".npy"):
                    continue
                with archive.open(item) as stream:
                    version = np.lib.format.read_magic(stream)
                    reader = (
                        np.lib.format.read_array_header_1_0
                        if version == (1, 0)
                        else np.lib.format.read_array_header_2_0
                    )
                    shape, _, kind = reader(stream)
                count = int(np.prod(shape, dtype=object)) if shape else 1
                if kind.hasobject or count * kind.itemsize > item.file_size:
                    raise ValueError(f"{item.filename} claims {shape} of {kind}")
                with archive.open(item) as stream:
                    tree[item.filename[:-4]] = np.lib.format.read_array(stream, allow_pickle=False)
    except Exception as fault:  # zipfile and numpy meet damaged bytes with errors of many kinds
        reason = str(fault).strip().splitlines()[0][:120] if str(fault).strip() else type(fault).__name__
        raise KinematicsError.of(path.name, "a readable NPZ archive", reason, "", step) from fault
    return tree


def _flatten(tree: Mapping[str, Any], start: str = "") -> dict[str, NDArray[Any]]:
    """Return the numbers in a tree under names with dots."""
    arrays: dict[str, NDArray[Any]] = {}
    for name, value in tree.items():
        if isinstance(value, Mapping):
            arrays.update(_flatten(value, f"{start}{name}."))
        elif isinstance(value, list) and value and all(isinstance(entry, Mapping) for entry in value):
            for number, entry in enumerate(value, 1):
                arrays.update(_flatten(entry, f"{start}{name}({number})."))
        elif isinstance(value, list) and value and all(isinstance(entry, np.ndarray) for entry in value):
            sizes = {entry.size for entry in value}
            if len(sizes) == 1 and all(entry.dtype.kind in "fiu" for entry in value):
                arrays[start + name] = np.array([entry.reshape(-1) for entry in value])
        elif np.asarray(value).dtype.kind in "fiu":
            arrays[start + name] = np.asarray(value)
    return arrays


def _of_tree(tree: Mapping[str, Any], file: str, names: Sequence[str]) -> Series:
    flat = _flatten(tree)
    low = {name.lower(): name for name in reversed(list(flat))}
    matched = _match(names, list(flat), file)
    rate = next((low[name] for name in RATES if name in low and flat[low[name]].size == 1), "")
    longest = max(max(flat[name].shape, default=0) for name in matched.values())
    time = next((low[name] for name in TIMES if name in low and flat[low[name]].size == longest), "")
    start = 0.0
    faults: list[Fault] = []
    sampled = float("nan")
    with collect_faults(faults):
        if time:
            times = flat[time].astype(float, copy=False).reshape(-1)
            sampled, start = sampling_rate(times, f"{file}, {time}"), float(times[0])
        elif rate:
            sampled = float(flat[rate].reshape(-1)[0])
            if not (0.0 < sampled <= HIGHEST_HZ):
                want = f"positive, up to {HIGHEST_HZ:g} Hz"
                faults.append(Fault("the sampling rate", want, f"{sampled:g} Hz", file))
        else:
            step = "Add sample_rate_hz (a number) or time_s (s, one a sample)"
            got = f"the variables {', '.join(list(flat)[:20])}"
            faults.append(Fault("the file", "with a sampling rate", got, file, step))
    channels: dict[str, tuple[Array, ...]] = {}
    for name, key in matched.items():
        with collect_faults(faults):
            channels[name] = _rows(flat[key], f"{file}, {key}")
    with collect_faults(faults):
        check_finite(channels, file)
    raise_all(KinematicsError, faults)
    set_to = next((low[name] for name in ("freq_hz", "set_freq_hz") if name in low), "")
    steps = _rows(flat[set_to], f"{file}, {set_to}") if set_to and set_to not in matched.values() else ()
    return Series(file, sampled, start, channels, steps)


def _rows(values: NDArray[Any], where: Place | str) -> tuple[Array, ...]:
    """Return rows of samples; the longer side is time."""
    rows = values.astype(float, copy=False)
    if rows.ndim > 2 and np.sum(np.array(rows.shape) > 1) <= 2:
        rows = rows.squeeze()
    if rows.ndim > 2 or rows.size < _FEWEST:
        want = f"samples, or rows x samples ({_FEWEST} at least)"
        raise KinematicsError.of("a channel", want, f"shape {values.shape}", where)
    if rows.ndim == 2:
        rows = rows if rows.shape[1] >= rows.shape[0] else rows.T
    return tuple(np.atleast_2d(rows))


def _wav(path: Path, names: Sequence[str]) -> Series:
    from scipy.io import wavfile

    step = "It is truncated or damaged: record or copy it again"
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            warnings.filterwarnings("ignore", message="Chunk .non-data. not understood")
            rate, data = wavfile.read(path)
    except Exception as fault:  # the reader meets damaged bytes with errors of many kinds
        reason = str(fault).splitlines()[0][:120] if str(fault) else type(fault).__name__
        raise KinematicsError.of(path.name, "a readable WAV file", reason, "", step) from fault
    if len(data) < _FEWEST:
        want = f"of at least {_FEWEST} samples"
        raise KinematicsError.of("a recording", want, len(data), path.name, step)
    full = 1.0
    if data.dtype.kind in "iu":
        full = float(np.iinfo(data.dtype).max) + 1.0
        data = data.astype(float) - (128.0 if data.dtype == np.uint8 else 0.0)
        full = 128.0 if full == 256.0 else full
    with np.errstate(invalid="ignore"):
        data = np.atleast_2d(data.T).astype(float) / full
    known = [str(k) for k in range(1, len(data) + 1)]
    matched = _match(names, known, path.name)
    channels = {name: (data[int(key) - 1],) for name, key in matched.items()}
    check_finite(channels, path.name)
    return Series(path.name, float(rate), 0.0, channels)
