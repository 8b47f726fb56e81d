"""Motion files: ``dof.csv`` for people and other tools, ``dof.h5`` with covariances and shared errors."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from legacy.stapeskit.arrays import Array
from legacy.stapeskit.faults import Fault, Place, StapeskitError, raise_all
from legacy.stapeskit.guard import read_apart
from legacy.stapeskit.json_toml import parse_json
from legacy.stapeskit.own_files import check_whole
from legacy.stapeskit.provenance import content_hash
from legacy.stapeskit.records.hdf5_writing import larger_than_file, write_h5
from legacy.stapeskit.records.motion import ROW_COLUMNS, STORED, RigidMotion, SharedErrors
from legacy.stapeskit.records.motion_columns import MotionColumns, columns_of
from legacy.stapeskit.tables.csv_table import Table, read_table
from legacy.stapeskit.tables.text_cells import as_text_cell, from_text_cell
from legacy.stapeskit.units import HIGHEST_HZ, LARGEST, LOWEST_HZ
from legacy.stapeskit.warnings import Notice, from_json

SCHEMA = "stapeskit.dof/1"
_WANTED = "a whole HDF5 file of points2dof"
# Rows written at a time.
_ROWS = 2000


def line_covariance(motion: RigidMotion) -> NDArray[np.complex128]:
    """Return the covariance of each body alone, (run, body, freq, dof, dof), also of a joint one."""
    if not motion.reference:
        return motion.covariance
    n, bodies = len(motion.dof), len(motion.bodies)
    runs, lines = len(motion.runs), len(motion.freq_hz)
    blocks = motion.covariance.reshape(runs, lines, bodies, n, bodies, n)
    return np.stack([blocks[:, :, b, :, b, :] for b in range(bodies)], axis=1)


def standard_deviation(motion: RigidMotion) -> Array:
    """Return the sd of the real (= imaginary) part of q, (run, body, freq, dof), m and rad."""
    variance = np.real(np.diagonal(line_covariance(motion), axis1=-2, axis2=-1))
    return np.asarray(np.sqrt(np.maximum(variance, 0.0) / 2.0))


def write_motion(
    folder: Path, stem: str, motion: RigidMotion, hash_of: Callable[[Path], str] = content_hash
) -> tuple[Path, Path]:
    """Write ``<stem>.csv`` and ``<stem>.h5`` into a folder and return their paths.

    A line at which a body's motion is not determined has no row. The HDF5 file holds the hash of the
    CSV file, so that a reader knows whether the two still belong together.
    """
    csv_path, h5_path = Path(folder) / f"{stem}.csv", Path(folder) / f"{stem}.h5"
    _write_csv(csv_path, motion)
    _write_h5(h5_path, motion, hash_of(csv_path))
    return csv_path, h5_path


def _write_csv(path: Path, motion: RigidMotion) -> None:
    """Write the rows of all determined lines: q with all its digits, sd with 9."""
    runs, bodies, _, dof = motion.q.shape
    names = MotionColumns(motion.dof, bool(motion.reference)).all
    sd = standard_deviation(motion)
    freq = [repr(value) for value in motion.freq_hz.tolist()]
    forms = [column.form for column in ROW_COLUMNS]
    pattern = ",".join(["%s", *["%r"] * (2 * dof), *["%.9g"] * dof, *forms]) + "\n"
    more = np.stack([column.of(motion) for column in ROW_COLUMNS], axis=-1)
    with path.open("w", encoding="utf-8", newline="") as file:
        file.write(",".join(names) + "\n")
        for run, body in np.ndindex(runs, bodies):
            start = _cell(motion.runs[run]) + "," + _cell(motion.bodies[body]) + ","
            determined = np.flatnonzero(np.isfinite(motion.q[run, body, :, 0].real))
            for first in range(0, len(determined), _ROWS):
                pick = determined[first : first + _ROWS]
                q = motion.q[run, body, pick]
                parts = np.stack([q.real, q.imag], axis=-1).reshape(len(q), -1)
                table = np.hstack([parts, sd[run, body, pick], more[run, body, pick]])
                values: list[Any] = []
                for line, row in zip(pick.tolist(), table.tolist(), strict=True):
                    values.append(start + freq[line])
                    values += row
                text = (pattern * len(pick)) % tuple(values)
                file.write(text if np.all(np.isfinite(table)) else re.sub(r"(?<=,)-?nan(?=[,\n])", "", text))


def _cell(text: str) -> str:
    """Return a name as a cell of a CSV file: no formula, and in quotes where it needs them."""
    text = as_text_cell(text)
    if any(mark in text for mark in ',"\r\n') or text != text.strip():
        return '"' + text.replace('"', '""') + '"'
    return text


def _write_h5(path: Path, motion: RigidMotion, csv_hash: str) -> None:
    import h5py

    with write_h5(path) as file:
        file.attrs["schema"] = SCHEMA
        file.attrs["about"], file.attrs["axes"] = motion.about, motion.axes
        file.attrs["reference"], file.attrs["csv_hash"] = motion.reference, csv_hash
        file.attrs["units"] = "q: m and rad, peak displacement amplitudes, e^{+iwt}; covariance: E[dq dq^H]"
        file.attrs["notices"] = json.dumps([notice.as_json() for notice in motion.notices])
        file.attrs["provenance"] = json.dumps(dict(motion.provenance))
        for name in ("runs", "bodies", "dof"):
            file[name] = np.array(getattr(motion, name), dtype=h5py.string_dtype())
        for name in ("freq_hz", "q", "covariance", *(column.name for column in STORED), "common_sd"):
            if getattr(motion, name) is not None:
                _store(file, name, getattr(motion, name))
        if motion.shared is not None:
            group = file.create_group("shared")
            group["names"] = np.array(motion.shared.names, dtype=h5py.string_dtype())
            _store(group, "covariance", motion.shared.covariance)
            _store(group, "derivatives", motion.shared.derivatives)


def _store(group: Any, name: str, values: NDArray[Any]) -> None:
    """Store an array with checksums, so that a damaged file is refused instead of read."""
    values = np.asarray(values)
    group.create_dataset(name, data=values, **({"fletcher32": True} if values.size else {}))


def read_motion(path: Path) -> RigidMotion:
    """Read ``dof.csv`` or ``dof.h5``.

    A CSV file is completed from the HDF5 file of the same name when that one was written with it; a CSV
    file without its HDF5 file, or changed since, gives uncorrelated noise from its sd columns
    and no shared errors.

    Raises
    ------
    StapeskitError
        The file is missing, is no motion file, or holds rows that are not as they must be; every fault of a
        CSV file is listed.
    """
    path = Path(path)
    if not path.is_file():
        raise StapeskitError.of(
            "the motion file", "an existing dof.csv or dof.h5", path, next_step="Run points2dof first"
        )
    check_whole(path)
    if path.suffix.lower() in (".h5", ".hdf5"):
        return read_apart(lambda: _read_h5(path), path, _WANTED)
    if path.suffix.lower() != ".csv":
        raise StapeskitError.of("a motion file", "a .csv or .h5 file of points2dof", path.name)
    beside = path.with_suffix(".h5")
    if beside.is_file():
        csv_hash = content_hash(path)
        motion = read_apart(lambda: _read_h5_of(beside, csv_hash), beside, _WANTED)
        if motion is not None:
            return motion
    notice = Notice(
        "motion_without_h5",
        f"{path.name} is read alone ({beside.name} is missing, unreadable or of other content): noise is "
        "taken as uncorrelated between the degrees of freedom, and no registration error is known.",
    )
    return _read_csv(path, notice)


def _read_h5_of(path: Path, csv_hash: str) -> RigidMotion | None:
    """Read an HDF5 file if it was written with the CSV file of that hash."""
    import h5py

    try:
        with h5py.File(path, "r") as file:
            stored = str(file.attrs.get("csv_hash", ""))
    except (OSError, RuntimeError, TypeError, ValueError):
        return None
    return _read_h5(path) if stored == csv_hash else None


def _read_h5(path: Path) -> RigidMotion:
    import h5py

    try:
        with h5py.File(path, "r") as file:
            if file.attrs.get("schema") != SCHEMA:
                raise StapeskitError.of(
                    "schema",
                    f'"{SCHEMA}"',
                    file.attrs.get("schema"),
                    path.name,
                    "Make the file with points2dof",
                )
            large = larger_than_file(file, path.stat().st_size)
            if large:
                raise ValueError(f"{large} of more bytes than the file")
            return _motion_from_h5(file)
    except StapeskitError:
        raise
    except (OSError, KeyError, AttributeError, TypeError, ValueError, RuntimeError) as fault:
        step = "Make the file with points2dof"
        raise StapeskitError.of("the motion file", _WANTED, f"{fault}", path.name, step) from fault


def _motion_from_h5(file: Any) -> RigidMotion:
    parts: dict[str, Any] = {
        key: tuple(word.decode() for word in file[key][()]) for key in ("runs", "bodies", "dof")
    }
    later = {column.name for column in STORED if column.optional and column.name not in file}
    names = ("freq_hz", "q", "covariance", *(column.name for column in STORED))
    parts |= {name: None if name in later else file[name][()] for name in names}
    shared = None
    if "shared" in file:
        group = file["shared"]
        shared = SharedErrors(
            tuple(word.decode() for word in group["names"][()]),
            group["covariance"][()],
            group["derivatives"][()],
        )
    return RigidMotion(
        **parts,
        reference=str(file.attrs["reference"]),
        about=str(file.attrs["about"]),
        axes=str(file.attrs["axes"]),
        shared=shared,
        notices=from_json(parse_json(file.attrs["notices"])),
        provenance=parse_json(file.attrs["provenance"]),
        common_sd=file["common_sd"][()] if "common_sd" in file else None,
    )


def _read_csv(path: Path, notice: Notice) -> RigidMotion:
    def choose(header: Sequence[str], name: str) -> tuple[set[str], set[str]]:
        columns = columns_of(header)
        missing = [column for column in columns.needed if column not in header]
        if not columns.dof:
            missing = ["x_re_m or another degree of freedom"]
        if missing:
            place = Place(name, "line", (1,))
            got, step = f"no column {', '.join(missing)}", "Give dof.csv or dof.h5 of points2dof"
            raise StapeskitError.of("a motion file", "complete", got, place, step)
        numbers = {*columns.needed, *(column.name for column in STORED)} - {"body"}
        return numbers & set(header), {"run", "body"} & set(header)

    table = read_table(path, choose)
    return _motion_from_table(table, notice)


def _motion_from_table(table: Table, notice: Notice) -> RigidMotion:
    columns = columns_of(table.numbers)
    dof = columns.dof
    body, freq = table.texts["body"], table.numbers["freq_hz"]
    bodies = tuple(map(from_text_cell, body.names))
    runs = tuple(map(from_text_cell, table.texts["run"].names)) if "run" in table.texts else ("1",)
    run = table.texts["run"].codes if "run" in table.texts else np.zeros(len(table), dtype=np.intp)
    sd = np.column_stack([table.numbers[name] for name in columns.deviations])
    faults = [*table.faults, *_row_faults(table, freq, sd)]
    lines, line = np.unique(freq, return_inverse=True)
    shape = (len(runs), len(bodies), len(lines))
    if not faults:
        place = np.ravel_multi_index((run, body.codes, line), shape)
        _, first = np.unique(place, return_index=True)
        for row in np.setdiff1d(np.arange(len(place)), first):
            faults.append(
                Fault(
                    "a row", "the only one of its run, body and frequency", "another", table.where(int(row))
                )
            )
    raise_all(StapeskitError, faults)
    q = np.full((*shape, len(dof)), np.nan + 0j)
    variance = np.full(q.shape, np.nan)
    at = (run, body.codes, line)
    for k, (real, imaginary) in enumerate(zip(columns.real, columns.imaginary, strict=True)):
        q[(*at, k)] = table.numbers[real] + 1j * table.numbers[imaginary]
        variance[(*at, k)] = 2.0 * sd[:, k] ** 2
    stored: dict[str, Any] = {}
    for column in STORED:
        cells = np.full(shape, np.nan)
        if column.name in table.numbers:
            cells[at] = table.numbers[column.name]
        elif column.optional:
            continue
        stored[column.name] = column.fill_missing(cells)
    covariance: NDArray[np.complex128] = (variance[..., None] * np.eye(len(dof))).astype(complex)
    reference = ""
    if columns.per_reference:
        reference = _reference_of(q, bodies, dof, table.file)
        joint = np.zeros((shape[0], shape[2], shape[1] * len(dof), shape[1] * len(dof)), dtype=complex)
        for owner in range(shape[1]):
            part = slice(owner * len(dof), (owner + 1) * len(dof))
            joint[:, :, part, part] = covariance[:, owner]
        covariance = joint
    return RigidMotion(
        runs, bodies, dof, lines, q, covariance, **stored, reference=reference, notices=(notice,)
    )


def _row_faults(table: Table, freq: Array, sd: Array) -> list[Fault]:
    faults = []
    reported = table.invalid_rows("freq_hz")
    for row in np.flatnonzero(~(freq >= LOWEST_HZ) | (freq > HIGHEST_HZ)):
        if not (reported[row] and np.isnan(freq[row])):
            finite = 0.0 < freq[row] < np.inf
            want = f"from {LOWEST_HZ:g} to {HIGHEST_HZ:g} Hz" if finite else "positive and finite"
            faults.append(Fault("freq_hz", want, f"{freq[row]:g}", table.where(int(row))))
    for column in STORED:
        values = table.numbers.get(column.name, np.zeros(0))
        for row in np.flatnonzero(column.is_wrong(values)):
            faults.append(Fault(column.name, column.expected, f"{values[row]:g}", table.where(int(row))))
    for row in np.flatnonzero(np.any((sd < 0.0) | (sd > LARGEST), axis=1)):
        faults.append(
            Fault("a standard deviation", "positive and finite", sd[row].tolist(), table.where(int(row)))
        )
    for name, values in table.numbers.items():
        large = np.flatnonzero(np.abs(values) > LARGEST) if "_re_" in name or "_im_" in name else ()
        for row in large:
            where = table.where(int(row))
            want = "finite, or empty" if np.isinf(values[row]) else f"below {LARGEST:g}, or empty"
            faults.append(Fault(name, want, f"{values[row]:g}", where))
    for name, cells in table.texts.items():
        for row in np.flatnonzero(cells.codes < 0):
            faults.append(Fault(name, "a name", "an empty cell", table.where(int(row))))
    return faults


def _reference_of(q: NDArray[np.complex128], bodies: tuple[str, ...], dof: tuple[str, ...], name: str) -> str:
    """Find the degree of freedom that is 1 at all lines."""
    for body, body_name in enumerate(bodies):
        for place, dof_name in enumerate(dof):
            values = q[:, body, :, place]
            values = values[~np.isnan(values.real)]
            if values.size and np.all(np.abs(values - 1.0) < 1e-9):
                return f"{body_name}:{dof_name}"
    raise StapeskitError.of(
        "a motion file per reference", "1 in the column of its reference", "no such column", name
    )
