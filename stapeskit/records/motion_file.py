"""Read and write rigid motion: ``dof.csv`` for people and ``dof.h5`` with everything."""

from __future__ import annotations

import io
import json
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from stapeskit.arrays import ComplexArray
from stapeskit.faults import Fault, Place, StapeskitError, raise_all
from stapeskit.provenance import sha256
from stapeskit.records.rigid_motion import RigidMotion as RigidMotion
from stapeskit.records.rigid_motion import SharedErrors as SharedErrors
from stapeskit.sandbox import read_apart
from stapeskit.spatial import DOF_NAMES, DOF_UNITS
from stapeskit.tables import Table, TextColumn, read_table, write_columns
from stapeskit.units import HIGHEST_HZ, LARGEST, LOWEST_HZ
from stapeskit.warnings import Notice, from_json

if TYPE_CHECKING:
    from pandas import DataFrame

SCHEMA = "stapeskit.dof/1"
MADE_BY = "Make the file with points2dof"
_LARGEST_COUNT = 1e15  # above it a double is no exact count
_FINITE = f"finite and below {LARGEST:g}, or empty"
_LIMITS = {
    "freq_hz": (LOWEST_HZ, HIGHEST_HZ, f"from {LOWEST_HZ:g} to {HIGHEST_HZ:g} Hz"),
    "chi2": (0.0, _LARGEST_COUNT, f"from 0 to {_LARGEST_COUNT:g}"),
    "n_dof": (0.0, _LARGEST_COUNT, f"a count up to {_LARGEST_COUNT:g}"),
}
_PER_REFERENCE = "_per_ref"
_FURTHER = ("chi2", "n_dof")
# What is stored, by its kind: fields of RigidMotion, and arrays of its SharedErrors.
_TEXTS, _WORDS = ("runs", "bodies", "dof"), ("reference", "about", "axes")
_ARRAYS = ("freq_hz", "q", "covariance", *_FURTHER)
_SHARED = ("covariance", "derivatives", "maps", "powers")


def motion_columns(dof: Sequence[str], per_reference: bool = False) -> dict[str, list[str]]:
    """Return the names of the columns of some degrees of freedom by part: ``re``, ``im``, ``sd``."""
    end = _PER_REFERENCE if per_reference else ""
    return {part: [f"{name}_{part}_{DOF_UNITS[name]}{end}" for name in dof] for part in ("re", "im", "sd")}


def write_motion(folder: Path, stem: str, motion: RigidMotion) -> tuple[Path, Path]:
    """Write ``<stem>.csv`` and ``<stem>.h5``, which holds its hash, into a folder and return their paths.

    A line at which a body's motion is not determined has no row.
    """
    csv_path, h5_path = Path(folder) / f"{stem}.csv", Path(folder) / f"{stem}.h5"
    _write_csv(csv_path, motion)
    _write_h5(h5_path, motion, f"sha256:{sha256(csv_path)}")
    return csv_path, h5_path


def write_motion_mat(path: Path, motion: RigidMotion) -> None:
    """Write a motion for MATLAB and Octave (version 5): SI, dimensions in the order of `RigidMotion`."""
    from scipy.io import savemat

    readme = (
        "q: run x body x line x dof, displacement, peak, e^(+iwt), m and rad, or per unit of the reference; "
        "q_sd: of the real (= imaginary) part, channel noise only"
    )
    content: dict[str, Any] = {"readme": readme, "q_sd": motion.standard_deviation}
    content |= {name: getattr(motion, name) for name in (*_TEXTS, *_WORDS, *_ARRAYS)}
    if motion.shared is not None:
        content |= {f"shared_{name}": getattr(motion.shared, name) for name in ("names", *_SHARED)}
    cells = {name: np.array(value, object) for name, value in content.items() if isinstance(value, tuple)}
    content = {name: value for name, value in (content | cells).items() if value is not None}
    savemat(path, content, oned_as="column")


def motion_table(motion: RigidMotion) -> DataFrame:
    """Return the rows of all determined lines: run, body, frequency, q, sd, chi2 and n_dof."""
    import pandas as pd

    return pd.DataFrame(_columns(motion))


def _columns(motion: RigidMotion) -> dict[str, NDArray[Any]]:
    names = motion_columns(motion.dof, bool(motion.reference))
    run, body, line = np.nonzero(np.isfinite(motion.q[..., 0].real))
    q, sd = motion.q[run, body, line], motion.standard_deviation[run, body, line]
    columns = {
        "run": np.array(motion.runs, dtype=object)[run],
        "body": np.array(motion.bodies, dtype=object)[body],
        "freq_hz": motion.freq_hz[line],
    }
    for place, (real, imaginary) in enumerate(zip(names["re"], names["im"], strict=True)):
        columns |= {real: q[:, place].real, imaginary: q[:, place].imag}
    columns |= {name: sd[:, place] for place, name in enumerate(names["sd"])}
    columns |= {"chi2": motion.chi2[run, body, line], "n_dof": motion.n_dof[run, body, line].astype(int)}
    return columns


def _write_csv(path: Path, motion: RigidMotion) -> None:
    """Write the rows of all determined lines: q with all its digits, sd and chi2 with nine."""
    columns = {name: column.tolist() for name, column in _columns(motion).items()}
    for name in (*motion_columns(motion.dof, bool(motion.reference))["sd"], "chi2"):
        columns[name] = [f"{value:.9g}" if np.isfinite(value) else value for value in columns[name]]
    write_columns(path, columns)


def _write_h5(path: Path, motion: RigidMotion, csv_hash: str) -> None:
    """Write the HDF5 file; made in memory, since on a full disk the library would end the process."""
    import h5py

    image = io.BytesIO()
    with h5py.File(image, "w") as file:
        file.attrs["schema"], file.attrs["csv_hash"] = SCHEMA, csv_hash
        file.attrs["units"] = "q: m and rad, peak displacement amplitudes, e^{+iwt}; covariance: E[dq dq^H]"
        file.attrs["notices"] = json.dumps([notice.as_json() for notice in motion.notices])
        file.attrs["provenance"] = json.dumps(dict(motion.provenance))
        for name in _WORDS:
            file.attrs[name] = getattr(motion, name)
        _store(file, motion, _TEXTS, _ARRAYS)
        if motion.shared is not None:
            _store(file.create_group("shared"), motion.shared, ("names",), _SHARED)
    path.write_bytes(image.getvalue())


def _store(group: Any, source: object, texts: Sequence[str], arrays: Sequence[str]) -> None:
    """Store attributes that are there; arrays with checksums, so that a damaged file is refused."""
    import h5py

    for name in texts:
        group[name] = np.array(getattr(source, name), dtype=h5py.string_dtype())
    for name in arrays:
        values = getattr(source, name)
        if values is not None:
            group.create_dataset(name, data=values, **({"fletcher32": True} if values.size else {}))


def read_motion(path: Path) -> RigidMotion:
    """Read ``dof.csv`` or ``dof.h5``.

    A CSV file is completed from the HDF5 file of the same name that was written with it; without, or changed
    since, it gives uncorrelated noise from its sd columns and no shared errors.

    Raises
    ------
    StapeskitError
        The file is missing, is no motion file, or holds rows that are not as they must be; every fault of a
        CSV file is listed.
    """
    path = Path(path)
    if not path.is_file():
        step = "Run points2dof first"
        raise StapeskitError.of("the motion file", "an existing dof.csv or dof.h5", path, next_step=step)
    if path.suffix.lower() in (".h5", ".hdf5"):
        return _read_h5(path)[0]
    if path.suffix.lower() != ".csv":
        step = "Give the dof.csv or dof.h5 that points2dof wrote"
        raise StapeskitError.of("a motion file", "a .csv or .h5 file", path.name, "", step)
    beside = path.with_suffix(".h5")
    if beside.is_file():
        motion, csv_hash = _read_h5(beside)
        if csv_hash == f"sha256:{sha256(path)}":
            return motion
    text = (
        f"{path.name} is read alone ({beside.name} is missing, or belongs to another CSV file): noise is "
        "taken as uncorrelated between the degrees of freedom, and no registration error is known."
    )
    return _motion_from_table(read_table(path, _choose), Notice("motion_without_h5", text))


def _read_h5(path: Path) -> tuple[RigidMotion, str]:
    """Return the motion of an HDF5 file and the hash of the CSV file that was written with it."""

    def read() -> tuple[RigidMotion, str]:
        import h5py

        with h5py.File(path, "r") as file:
            schema = file.attrs.get("schema")
            if schema != SCHEMA:
                raise StapeskitError.of("schema", f'"{SCHEMA}"', schema, path.name, MADE_BY)
            return _motion_from_h5(file), str(file.attrs.get("csv_hash", ""))

    return read_apart(read, path, "the motion file", modules=("h5py",))


def _motion_from_h5(file: Any) -> RigidMotion:
    def stored(group: Any, texts: Sequence[str], arrays: Sequence[str]) -> dict[str, Any]:
        words = {name: tuple(word.decode() for word in group[name][()]) for name in texts}
        return words | {name: group[name][()] for name in arrays if name in group}

    shared = SharedErrors(**stored(file["shared"], ("names",), _SHARED)) if "shared" in file else None
    return RigidMotion(
        **stored(file, _TEXTS, _ARRAYS) | {name: str(file.attrs[name]) for name in _WORDS},
        shared=shared,
        notices=from_json(json.loads(file.attrs["notices"])),
        provenance=json.loads(file.attrs["provenance"]),
    )


def _dof_of(header: Collection[str]) -> tuple[str, ...]:
    """Return the degrees of freedom of a header."""
    return tuple(name for name in DOF_NAMES if any(column.startswith(f"{name}_re_") for column in header))


def _choose(header: Sequence[str], name: str) -> tuple[set[str], set[str]]:
    """Return the columns of numbers and of texts of a motion file."""
    dof, where = _dof_of(header), Place(name, "line", (1,))
    if any(column.endswith(_PER_REFERENCE) for column in header):
        got, step = "the CSV file alone", "Give the .h5 file that points2dof wrote with it"
        raise StapeskitError.of("motion per reference", "read with its covariance", got, where, step)
    needed = ["body", "freq_hz", *(column for part in motion_columns(dof).values() for column in part)]
    missing = [column for column in needed if column not in header]
    if missing or not dof:
        listed = ", ".join(missing if dof else ["x_re_m or another degree of freedom"])
        step = "Give dof.csv or dof.h5 of points2dof"
        raise StapeskitError.of("a motion file", "complete", f"no column {listed}", where, step)
    return ({*needed, *_FURTHER} - {"body"}) & set(header), {"run", "body"} & set(header)


def _motion_from_table(table: Table, notice: Notice) -> RigidMotion:
    dof = _dof_of(table.numbers)
    columns = motion_columns(dof)
    body, freq = table.texts["body"], table.numbers["freq_hz"]
    one_run = TextColumn(np.zeros(len(table), dtype=np.intp), ("1",))
    run = table.texts.get("run", one_run)
    faults = [*table.faults, *_cell_faults(table)]
    lines, line = np.unique(freq, return_inverse=True)
    shape = (len(run.names), len(body.names), len(lines))
    at = (run.codes, body.codes, line)
    if not faults:
        _, first = np.unique(np.ravel_multi_index(at, shape), return_index=True)
        expected = "the only one of its run, body and frequency"
        for row in np.setdiff1d(np.arange(len(table)), first):
            faults.append(Fault("a row", expected, "another", table.where(int(row))))
    raise_all(faults)

    def filled(values: NDArray[Any]) -> Any:
        whole = np.full((*shape, *values.shape[1:]), np.nan, dtype=values.dtype)
        whole[at] = values
        return whole

    real, imaginary, sd = (
        np.column_stack([table.numbers[name] for name in columns[part]]) for part in ("re", "im", "sd")
    )
    covariance: ComplexArray = (filled(2.0 * sd**2)[..., None] * np.eye(len(dof))).astype(complex)
    chi2, n_dof = (filled(table.numbers.get(name, np.full(len(table), np.nan))) for name in _FURTHER)
    counts, q = np.nan_to_num(n_dof).astype(int), filled(real + 1j * imaginary)
    return RigidMotion(run.names, body.names, dof, lines, q, covariance, chi2, counts, notices=(notice,))


def _cell_faults(table: Table) -> Iterator[Fault]:
    """Yield the cells that hold impossible values."""
    for name, values in table.numbers.items():
        is_sd = "_sd_" in name
        usual = (0.0, LARGEST, "positive and finite") if is_sd else (-LARGEST, LARGEST, _FINITE)
        low, high, expected = _LIMITS.get(name, usual)
        known = ~np.isnan(values) | ((name == "freq_hz") & ~table.invalid_rows(name))
        wrong = known & ~((values >= low) & (values <= high))
        if name == "n_dof":
            wrong |= known & (values != np.round(values))
        for row in np.flatnonzero(wrong).tolist():
            yield Fault(name, expected, f"{values[row]:g}", table.where(row))
    for name, cells in table.texts.items():
        for row in np.flatnonzero(cells.codes < 0).tolist():
            yield Fault(name, "a name", "an empty cell", table.where(row))
